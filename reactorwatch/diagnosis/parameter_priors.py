"""Parameters that are known, but not exactly: what is stated of them is a prior, and the record may say more.

Such a parameter is the model's plus an offset that never changes and that nobody measures. To the filter that is one
more state, at rest at nothing give or take the stated standard deviation. So it learns the offset as it goes, and the
likelihood of its innovations is that of the record whatever the offset may be, by the prior: the marginal likelihood
that a BIC stands for, alike for every hypothesis (Kass & Raftery 1995, Bayes factors, J. American Statistical
Association 90; that a filter's innovations have it, Schweppe 1965, IEEE Trans. Information Theory 11). No hypothesis
pays for an offset that is as likely as stated, the nominal one among them, and all intervals allow for it.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from math import isfinite

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.kalman.innovations import FilterResult
from reactorwatch.process.model import Parameter, ProcessModel, parameter, variable

_OFF, _BEGIN = ".off", ".begin"
_STATED = re.compile(r"\+?([\d.]+(?:[eE][-+]?\d+)?)\s*(\D.*)?")


def stated(text: str, model: ProcessModel) -> dict[str, float]:
    """What is said of parameters as text, such as `K3=2%,Tf=0.5K`: standard deviations by name, in their units.

    Args:
        text: of each a share of its value in per cent, or a number with the parameter's unit.
        model: that has the parameters.

    Raises:
        InputError: not such a text, or no such parameter.
    """
    found = {}
    for part in text.split(","):
        name, equals, value = (item.strip() for item in part.partition("="))
        said = _STATED.fullmatch(value)
        if not (name and equals and said):
            raise InputError(f"uncertain must be parameter=tolerance, such as K3=2%,Tf=0.5K, got {part.strip()!r}")
        item = _checked(name, model)
        unit = (said[2] or "").strip()
        if unit not in ("%", item.unit):
            raise InputError(f"uncertain {name} must be in % or in {item.unit}, got {value!r}")
        try:
            number = float(said[1])
        except ValueError:
            raise InputError(f"uncertain {name} must be a number with % or {item.unit}, got {value!r}") from None
        found[name] = 0.01 * number * abs(item.value) if unit == "%" else number
        _check_sd(name, found[name], item.unit)
    return found


def with_uncertain(model: ProcessModel, sds: Mapping[str, float]) -> ProcessModel:
    """The model with offsets of some parameters as states that never change; as it is where there are none.

    Args:
        model: of the plant.
        sds: standard deviation of each parameter, in its unit.

    Raises:
        InputError: there is no such parameter, or its standard deviation is not positive.
    """
    for name, sd in sds.items():
        item = _checked(name, model)
        _check_sd(name, sd, item.unit)
        bounds = (item.lower - item.value, item.upper - item.value)
        off = variable(f"{name}{_OFF}", item.unit, bounds, sd, f"what {name} is off by")
        begin = parameter(f"{name}{_BEGIN}", 0.0, item.unit, bounds, f"what {name} is taken to be off by")
        model = model.substitute(item.symbol, item.symbol + off.symbol).with_state(off, ca.SX(0.0), begin.symbol)
        model = replace(model, parameters=(*model.parameters, begin))
    return model


def offsets(model: ProcessModel, x: Array) -> dict[str, float]:
    """What the uncertain parameters are off by, by their names.

    Args:
        model: with or without such.
        x: states of it, shape (n_x,) or more.
    """
    return {model.states[place].name.removesuffix(_OFF): float(x[place]) for place in model.constant_states}


def beginning_with(known: Mapping[str, float]) -> dict[str, float]:
    """The changes of parameters with which a free run knows these offsets."""
    return {f"{name}{_BEGIN}": value for name, value in known.items()}


def last_state(found: FilterResult) -> int:
    """The last row in which a filter knows its state; the last one, if there is none."""
    known = np.flatnonzero(np.all(np.isfinite(found.x), axis=1))
    return int(known[-1]) if known.size else len(found.x) - 1


def _checked(name: str, model: ProcessModel) -> Parameter:
    valid = [item for item in model.parameter_names if item not in model.breakpoints]
    if name not in valid:
        raise InputError(f"uncertain must be of {', '.join(valid)}, got {name}")
    return model.parameter(name)


def _check_sd(name: str, sd: float, unit: str) -> None:
    if not (isfinite(sd) and sd > 0.0):
        raise InputError(f"uncertain {name} must be a positive number of {unit}, got {sd:g}")
