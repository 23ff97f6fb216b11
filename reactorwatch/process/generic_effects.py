"""Effects made from any model: of every output, input, parameter and state.

| of | effects |
|---|---|
| an output | `.bias`, `.gain`, `.lag`, `.delay`, `.stuck`, `.noise` |
| an input | `.gain`, `.offset`, `.lag`, `.delay`, `.stiction` |
| a parameter | `.deviation` from its value, as a share of it; in its unit where its value is 0, and of degC, degF |
| a state | `.source`, an unmodelled rate in its balance |

Their scales come from the model: those of its states and inputs, and how much an output or a balance changes with them
at a point inside the bounds. A process may have effects of its own instead, under names that people use; of its own and
generic ones that do the same to the model (`effect_twins`) it then has its own.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.process.effect import Effect, EffectConstant, ParameterEffect, ParameterShift, make_effect
from reactorwatch.process.input_effects import InputDelay, InputGain, InputLag, InputOffset, InputStiction
from reactorwatch.process.model import Output, Parameter, ProcessModel, Variable
from reactorwatch.process.output_effects import (
    OutputBias,
    OutputDelay,
    OutputGain,
    OutputLag,
    OutputNoise,
    StuckOutput,
)
from reactorwatch.units import absolute

TIMES_MIN = (0.05, 0.3, 2.0, 10.0)
"""Lags and delays from which fits start."""

LONGEST_MIN = 1000.0
"""Largest lag and delay."""

TYPICAL_SHARE, LARGEST_SHARE = 0.02, 4.0
"""Deviation of a parameter, as a share of its value, that is worth finding; the largest that is fitted."""

TYPICAL_SCALES, LARGEST_SCALES = 0.1, 20.0
"""The same for a bias, an offset, and a source in a minute, in scales of their quantity."""

STICTION_SCALES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Thresholds of a sticking input that are tried, in scales of the input."""


class Source(Effect):
    """An unmodelled source adds m to the balance of a state.

    It stands for anything that the equations of this balance lack: it has a location, and no physical meaning.

    Attributes:
        state: name of the state.
    """

    is_source = True
    state: str

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return model.add_rate(self.state, size)


class Exchange(Source):
    """An unmodelled flow adds m to the balance of a state and takes it from that of another one.

    Attributes:
        other: name of the other state.
        ratio: rate that m takes from it.
    """

    other: str
    ratio: float

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Source`."""
        return super().apply(model, size).add_rate(self.other, -self.ratio * size)


@lru_cache(maxsize=64)
def exchanges(model: ProcessModel) -> tuple[Effect, ...]:
    """Unmodelled flows between each two states of one unit that the model joins in both directions."""
    own = [index for index, item in enumerate(model.states) if item.name not in model.at_rest]
    slopes = _slopes(model, ca.vertcat(*model.rhs), model.arguments()[0])
    result = []
    for i in own:
        for j in own[:i]:
            one, other = model.states[j], model.states[i]
            if one.unit == other.unit and slopes[i, j] > 0.0 and slopes[j, i] > 0.0:
                result.append(
                    _make(
                        Exchange,
                        f"{one.name}.{other.name}.exchange",
                        f"An unmodelled flow from {other.name} to {one.name}.",
                        label=f"unknown flow between {one.name} and {other.name}",
                        location=balance_of(one),
                        state=one.name,
                        other=other.name,
                        ratio=float(slopes[i, j] / slopes[j, i]),
                        **_deviation(f"{one.unit}/min", one.scale),
                    )
                )
    return tuple(result)


@lru_cache(maxsize=64)
def generic_effects(model: ProcessModel) -> tuple[Effect, ...]:
    """Effects of every output, input, parameter and state of a model; not of what effects have added to it."""
    effects: list[Effect] = []
    for output, scale in zip(model.outputs, output_scales(model), strict=True):
        effects += _of_output(model, output, scale)
    for item in model.inputs:
        effects += _of_input(item)
    own = [item for item in model.parameters if "." not in item.name and item.name not in model.breakpoints]
    effects += [_of_parameter(model, item) for item in own]
    return (*effects, *(_of_state(item) for item in model.states if item.name not in model.at_rest))


def is_generic(effect: Effect) -> bool:
    """True if an effect was made from a model."""
    return type(effect).__module__ == __name__


def reference_point(model: ProcessModel) -> tuple[Array, Array]:
    """States and inputs inside their bounds, no two at the same share of their ranges."""
    count = len(model.states) + len(model.inputs)
    shares = iter(0.3 + 0.4 * np.modf(0.618034 * np.arange(1, count + 1))[0])
    x, u = (
        np.array([item.lower + share * (item.upper - item.lower) for item, share in zip(items, shares, strict=False)])
        for items in (model.states, model.inputs)
    )
    return x, u


def output_scales(model: ProcessModel) -> list[float]:
    """Typical magnitudes of the changes of the outputs, from those of the states and inputs."""
    outputs = ca.vertcat(*(output.expression for output in model.outputs))
    scales = np.array([item.scale for item in (*model.states, *model.inputs)])
    moved = np.abs(_slopes(model, outputs, ca.vertcat(*model.arguments()[:2]))) @ scales
    return [float(value) if np.isfinite(value) and value > 0.0 else 1.0 for value in moved]


def _slopes(model: ProcessModel, expressions: ca.SX, by: ca.SX) -> Array:
    """Derivatives of expressions with respect to symbols at the reference point."""
    symbols = [*model.arguments(), model.clock.now, model.clock.middle]
    slopes = ca.Function("slopes", symbols, [ca.jacobian(expressions, by)])
    return np.array(slopes(*reference_point(model), model.values(), 0.0, 0.0))


_make: Callable[..., Effect] = partial(make_effect, module=__name__)


def _deviation(unit: str, scale: float) -> dict[str, Any]:
    """Size of a bias, an offset or a rate, from a scale in its unit."""
    reach = LARGEST_SCALES * scale
    return {"unit": unit, "lower": -reach, "upper": reach, "typical": TYPICAL_SCALES * scale}


def _of_output(model: ProcessModel, output: Output, scale: float) -> list[Effect]:
    name, unit = output.name, output.unit
    at = {"output": name, "location": name}
    reach, in_unit = LARGEST_SCALES * scale, "" if unit == "1" else f" {unit}"
    times = {**at, "scale": scale, "upper": LONGEST_MIN, "start_values": TIMES_MIN}
    usual = model.function()(*reference_point(model), model.values(), 0.0, 0.0)[1]
    middle = float(usual[model.output_names.index(name)])
    stuck_at = EffectConstant("value", middle, reach, unit, middle - 1e3 * reach, middle + 1e3 * reach, "stuck reading")
    return [
        _make(
            OutputBias,
            f"{name}.bias",
            f"The measured {name} is too high by m.",
            label=f"bias of {name}",
            larger=f"{name} shows {{}}{in_unit} too much",
            smaller=f"{name} shows {{}}{in_unit} too little",
            labels={"ramp": f"drift of {name}"},
            **_deviation(unit, scale),
            **at,
        ),
        _make(
            OutputGain,
            f"{name}.gain",
            f"The measured {name} is the true one times (1 + m).",
            label=f"wrong gain of {name}",
            larger=f"{name} shows {{}} % too much",
            smaller=f"{name} shows {{}} % too little",
            typical=TYPICAL_SHARE,
            **at,
        ),
        _make(
            OutputLag,
            f"{name}.lag",
            f"The measured {name} follows the true one with a time constant of m.",
            label=f"slow sensor of {name}",
            larger=f"{name} follows with a time constant of {{}} min",
            **times,
        ),
        _make(
            OutputDelay,
            f"{name}.delay",
            f"The measured {name} is that of m before.",
            label=f"delayed {name}",
            larger=f"{name} shows what was there {{}} min before",
            delays_output=name,
            **times,
        ),
        _make(
            StuckOutput,
            f"{name}.stuck",
            f"The share m of the measured {name} is a constant.",
            label=f"stuck {name}",
            larger=f"{name} is stuck to {{}} %",
            constants=(stuck_at,),
            **at,
        ),
        _make(
            OutputNoise,
            f"{name}.noise",
            f"The measured {name} has further noise with a standard deviation of m.",
            label=f"noisier sensor of {name}",
            larger=f"{name} has further noise of {{}}{in_unit}",
            unit=unit,
            upper=reach,
            typical=TYPICAL_SCALES * scale,
            **at,
        ),
    ]


def _of_input(item: Variable) -> list[Effect]:
    name, unit = item.name, item.unit
    at = {"input": name, "location": name}
    in_unit = "" if unit == "1" else f" {unit}"
    times = {**at, "upper": LONGEST_MIN, "start_values": TIMES_MIN}
    return [
        _make(
            InputGain,
            f"{name}.gain",
            f"The real {name} is the commanded one times (1 + m).",
            label=f"wrong gain of {name}",
            larger=f"{{}} % more {name} than commanded",
            smaller=f"{{}} % less {name} than commanded",
            **at,
        ),
        _make(
            InputOffset,
            f"{name}.offset",
            f"The real {name} is the commanded one plus m.",
            label=f"offset of {name}",
            larger=f"{name} higher by {{}}{in_unit} than commanded",
            smaller=f"{name} lower by {{}}{in_unit} than commanded",
            **_deviation(unit, item.scale),
            **at,
        ),
        _make(
            InputLag,
            f"{name}.lag",
            f"The real {name} follows the commanded one with a time constant of m.",
            label=f"slow {name}",
            larger=f"{name} follows its command with a time constant of {{}} min",
            **times,
        ),
        _make(
            InputDelay,
            f"{name}.delay",
            f"The real {name} is what was commanded m before.",
            label=f"late {name}",
            larger=f"{name} follows its command {{}} min later",
            **times,
        ),
        _make(
            InputStiction,
            f"{name}.stiction",
            f"The real {name} moves only when its command is more than m away.",
            label=f"sticking {name}",
            larger=f"{name} moves only for changes of more than {{}}{in_unit}",
            unit=unit,
            upper=LARGEST_SCALES * item.scale,
            typical=0.2 * item.scale,
            start_values=tuple(share * item.scale for share in STICTION_SCALES),
            **at,
        ),
    ]


def _of_parameter(model: ProcessModel, item: Parameter) -> Effect:
    """Deviation as a share of the value; in its unit where the value is 0, or the unit's zero is no absolute one."""
    from_zero = absolute(item.value, item.unit)
    in_unit = not item.value or from_zero is not None
    scale = 1.0 if in_unit else item.value
    lower, upper = sorted((end - item.value) / scale for end in (item.lower, item.upper))
    usual = TYPICAL_SHARE
    if in_unit:  # of a temperature, as large as that of the same parameter in K
        usual = 1e-3 * (upper - lower) if from_zero is None else TYPICAL_SHARE * from_zero
    formula, unit = ("+ m", item.unit) if in_unit else ("(1 + m)", "%")
    return _make(
        ParameterShift if in_unit else ParameterEffect,
        f"{item.name}.deviation",
        f"{item.name} {formula}.",
        label=f"other {item.name} ({item.meaning})" if item.meaning else f"other {item.name}",
        location=parameter_location(model, item),
        parameter=item.name,
        unit=item.unit if in_unit else "1",
        larger=f"{item.name} higher by {{}} {unit}",
        smaller=f"{item.name} lower by {{}} {unit}",
        lower=lower if in_unit else max(lower, -0.99),
        upper=upper if in_unit else min(upper, LARGEST_SHARE),
        typical=min(usual, 0.5 * upper) or max(-usual, 0.5 * lower),
    )


def parameter_location(model: ProcessModel, item: Parameter) -> str:
    """Balance, or else output, that a parameter changes most, relative to the scales."""
    expressions = ca.vertcat(*model.rhs, *(output.expression for output in model.outputs))
    slopes = np.abs(_slopes(model, expressions, item.symbol)).ravel()
    scales = np.array([*(state.scale for state in model.states), *output_scales(model)])
    shares = np.nan_to_num(slopes / scales)
    states = len(model.states)
    if np.any(shares[:states]):
        return balance_of(model.states[int(np.argmax(shares[:states]))])
    return model.output_names[int(np.argmax(shares[states:]))]


def balance_of(state: Variable) -> str:
    """Location of the balance of a state: its name, where the model gives none."""
    return state.balance or state.name


def _of_state(item: Variable) -> Effect:
    return _make(
        Source,
        f"{item.name}.source",
        f"An unmodelled source adds m to the balance of {item.name}.",
        label=f"unknown source in the balance of {item.name}",
        location=balance_of(item),
        **_deviation(f"{item.unit}/min", item.scale),
        larger=f"{{}} {item.unit}/min more into the balance of {item.name}",
        smaller=f"{{}} {item.unit}/min less into the balance of {item.name}",
        state=item.name,
    )
