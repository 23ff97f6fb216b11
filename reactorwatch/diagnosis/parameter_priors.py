"""Priors on parameters, updated by the record.

An uncertain parameter is the model's value plus a constant offset. In the filter the offset is one more state,
initially zero with the stated standard deviation. So the filter estimates it, and the likelihood of its innovations is
marginal over the offset: the marginal likelihood that a BIC approximates, for every hypothesis alike (Kass & Raftery
1995, Bayes factors, J. American Statistical Association 90; by a filter's innovations, Schweppe 1965, IEEE Trans.
Information Theory 11). No hypothesis, the nominal one included, is charged for a likely offset, and all intervals allow
for it.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from math import isfinite

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.kalman.batch import FilterResult
from reactorwatch.process.model import Parameter, ProcessModel, parameter, variable
from reactorwatch.units import absolute

_OFF, _BEGIN = ".off", ".begin"
_PRIOR = re.compile(r"\+?([\d.]+(?:[eE][-+]?\d+)?)\s*(\D.*)?")


def parse_priors(text: str, model: ProcessModel) -> dict[str, float]:
    """Parse priors such as `K3=2%,Tf=0.5K`: standard deviations by name, in the parameters' units.

    Args:
        text: for each parameter a percentage of its value, or a number with its unit; of degC and degF only a number.
            0 is exact, and needs no unit.
        model: process model with the parameters.

    Raises:
        InputError: the text has another form, there is no such parameter, or its value is smaller.
    """
    result = {}
    for part in text.split(","):
        name, equals, value = (item.strip() for item in part.partition("="))
        match = _PRIOR.fullmatch(value)
        if not (name and equals and match):
            raise InputError(f"uncertain must be parameter=tolerance, such as K3=2%,Tf=0.5K, got {part.strip()!r}")
        item = _find_parameter(name, model)
        unit = (match[2] or "").strip()
        if unit not in ("%", item.unit) and value != "0":
            raise InputError(f"uncertain {name} must be in % or in {item.unit}, got {value!r}")
        if unit == "%" and absolute(item.value, item.unit) is not None:
            raise InputError(f"uncertain {name} must be in {item.unit}, of which a share is no size, got {value!r}")
        try:
            amount = float(match[1])
        except ValueError:
            raise InputError(f"uncertain {name} must be a number with % or {item.unit}, got {value!r}") from None
        result[name] = 0.01 * amount * abs(item.value) if unit == "%" else amount
        _check_sd(item, result[name])
    return result


def check_priors(model: ProcessModel, sds: Mapping[str, float]) -> None:
    """Check priors: arguments and errors as for `add_priors`."""
    for name, sd in sds.items():
        _check_sd(_find_parameter(name, model), sd)


def add_priors(model: ProcessModel, sds: Mapping[str, float]) -> ProcessModel:
    """Add offsets of parameters to the model as constant states.

    Args:
        model: process model of the plant.
        sds: standard deviation of each parameter, in its unit; 0: it is exact, and has no offset.

    Raises:
        InputError: there is no such parameter, or its standard deviation is negative or larger than its value.
    """
    check_priors(model, sds)
    for name in (name for name, sd in sds.items() if sd):
        item, sd = model.parameter(name), sds[name]
        bounds = (item.lower - item.value, item.upper - item.value)
        off = variable(f"{name}{_OFF}", item.unit, bounds, sd, f"offset of {name}")
        begin = parameter(f"{name}{_BEGIN}", 0.0, item.unit, bounds, f"initial offset of {name}")
        model = model.substitute(item.symbol, item.symbol + off.symbol).with_state(off, ca.SX(0.0), begin.symbol)
        model = replace(model, parameters=(*model.parameters, begin))
    return model


def offsets(model: ProcessModel, x: Array) -> dict[str, float]:
    """Offsets of the uncertain parameters, by name.

    Args:
        model: process model with or without offsets.
        x: states of the model, shape (n_x,) or more.
    """
    return {model.states[index].name.removesuffix(_OFF): float(x[index]) for index in model.constant_states}


def offset_changes(known: Mapping[str, float]) -> dict[str, float]:
    """Parameter changes with which a simulation has these offsets."""
    return {f"{name}{_BEGIN}": value for name, value in known.items()}


def last_finite_row(result: FilterResult) -> int:
    """Last row with a finite state; the last row if there is none."""
    known = np.flatnonzero(np.all(np.isfinite(result.x), axis=1))
    return int(known[-1]) if known.size else len(result.x) - 1


def _find_parameter(name: str, model: ProcessModel) -> Parameter:
    valid = [item for item in model.parameter_names if item not in model.breakpoints]
    if name not in valid:
        raise InputError(f"uncertain must be of {', '.join(valid)}, got {name}")
    return model.parameter(name)


def _check_sd(item: Parameter, sd: float) -> None:
    name, value, unit = item.name, abs(item.value), item.unit
    if not (isfinite(sd) and sd >= 0.0):
        raise InputError(f"uncertain {name} must be a number of {unit} that is not negative, got {sd:g}")
    if sd > value > 0.0 and absolute(value, unit) is None:
        raise InputError(
            f"uncertain {name} must be at most its value, {value:g} {unit}, got {sd:g}; "
            "state its standard deviation, or correct its value"
        )
