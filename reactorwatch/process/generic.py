"""Effects made from any model: of every output, input, parameter and state; and twins among effects.

| of | effects |
|---|---|
| an output | `.bias`, `.gain`, `.lag`, `.delay`, `.stuck`, `.noise` |
| an input | `.gain`, `.offset`, `.lag`, `.delay`, `.stiction` |
| a parameter | `.deviation` from its value, as a share of it; in its unit where its value is 0, and of degC, degF |
| a state | `.source`, an unmodelled rate in its balance |

Their scales come from the model: those of its states and inputs, and how much an output or a balance changes with them
at a point inside the bounds. A process may have effects of its own instead, under names that people use; of its own and
generic ones that do the same to the model it then has its own.

Twins do the same to a model, but for a factor of their sizes. They are found by what they do: the balances, outputs,
jumps and times of the model with either effect are compared at points within its bounds, at sizes that correspond. So a
name, or the code of an effect, does not matter.
"""

from collections.abc import Mapping
from functools import cached_property, lru_cache
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.process.effect import Effect, EffectConstant, ParameterEffect, ParameterShift
from reactorwatch.process.model import Output, Parameter, ProcessModel, Variable
from reactorwatch.process.signal_effects import (
    InputDelay,
    InputGain,
    InputLag,
    InputOffset,
    InputStiction,
    OutputBias,
    OutputDelay,
    OutputGain,
    OutputLag,
    OutputNoise,
    StuckOutput,
)
from reactorwatch.units import absolute

TIMES: dict[str, Any] = {"upper": 1000.0, "start_values": (0.05, 0.3, 2.0, 10.0)}
"""Lags and delays in minutes: the largest, and those from which fits start, a factor of six apart."""

TYPICAL_SHARE = 0.02
"""Deviation of a parameter, as a share of its value, that is worth finding."""

TYPICAL_SCALES, LARGEST_SCALES = 0.1, 20.0
"""The same for a bias, an offset, and a source in a minute, in scales of their quantity."""

POINTS = 8
"""Points at which models are compared: a factor that agrees at all of them by chance is out of the question."""


class Source(Effect):
    """An unmodelled source adds m to the balance of a state.

    It stands for anything that the equations of this balance lack: it has a location, and no physical meaning.

    Attributes:
        state: name of the state.
    """

    is_source = True
    state: ClassVar[str]

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return model.add_rate(self.state, size)


class Exchange(Source):
    """An unmodelled flow adds m to the balance of a state and takes it from that of another one.

    Attributes:
        other: name of the other state.
        ratio: rate that m takes from it.
    """

    other: ClassVar[str]
    ratio: ClassVar[float]

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
                    Exchange(
                        f"An unmodelled flow from {other.name} to {one.name}.",
                        name=f"{one.name}.{other.name}.exchange",
                        label=f"unknown flow between {one.name} and {other.name}",
                        is_generic=True,
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


_MEANINGS: dict[type[Effect], str] = {
    OutputBias: "The measured {} is too high by m.",
    OutputGain: "The measured {} is the true one times (1 + m).",
    OutputLag: "The measured {} follows the true one with a time constant of m.",
    OutputDelay: "The measured {} is that of m before.",
    StuckOutput: "The share m of the measured {} is a constant.",
    OutputNoise: "The measured {} has further noise with a standard deviation of m.",
    InputGain: "The real {} is the commanded one times (1 + m).",
    InputOffset: "The real {} is the commanded one plus m.",
    InputLag: "The real {} follows the commanded one with a time constant of m.",
    InputDelay: "The real {} is what was commanded m before.",
    InputStiction: "The real {} moves only when its command is more than m away.",
    ParameterEffect: "{} (1 + m).",
    ParameterShift: "{} + m.",
    Source: "An unmodelled source adds m to the balance of {}.",
}


def _make(kind: type[Effect], name: str, label: str, larger: str, smaller: str = "", **facts: Any) -> Effect:
    meaning = _MEANINGS[kind].format(name.rpartition(".")[0])
    return kind(meaning, name=name, label=label, larger=larger, smaller=smaller, is_generic=True, **facts)


def _deviation(unit: str, scale: float) -> dict[str, Any]:
    """Size of a bias, an offset or a rate, from a scale in its unit."""
    reach = LARGEST_SCALES * scale
    return {"unit": unit, "lower": -reach, "upper": reach, "typical": TYPICAL_SCALES * scale}


def _of_output(model: ProcessModel, output: Output, scale: float) -> list[Effect]:
    name, unit = output.name, output.unit
    at: dict[str, Any] = {"output": name, "location": name}
    reach, in_unit = LARGEST_SCALES * scale, "" if unit == "1" else f" {unit}"
    times: dict[str, Any] = {**at, "scale": scale, **TIMES}
    usual = model.function()(*reference_point(model), model.values(), 0.0, 0.0)[1]
    middle = float(usual[model.output_names.index(name)])
    stuck_at = EffectConstant("value", middle, reach, unit, middle - 1e3 * reach, middle + 1e3 * reach, "stuck reading")
    too_much = f"{name} shows {{}}{in_unit} too much", f"{name} shows {{}}{in_unit} too little"
    share = f"{name} shows {{}} % too much", f"{name} shows {{}} % too little"
    follows, before = f"{name} follows with a time constant of {{}} min", f"{name} shows what was there {{}} min before"
    noisier = f"{name} has further noise of {{}}{in_unit}"
    noise: dict[str, Any] = {"unit": unit, "upper": reach, "typical": TYPICAL_SCALES * scale, **at}
    bias: dict[str, Any] = {"labels": {"ramp": f"drift of {name}"}, **_deviation(unit, scale), **at}
    return [
        _make(OutputBias, f"{name}.bias", f"bias of {name}", *too_much, **bias),
        _make(OutputGain, f"{name}.gain", f"wrong gain of {name}", *share, typical=TYPICAL_SHARE, **at),
        _make(OutputLag, f"{name}.lag", f"slow sensor of {name}", follows, **times),
        _make(OutputDelay, f"{name}.delay", f"delayed {name}", before, delays_output=name, **times),
        _make(StuckOutput, f"{name}.stuck", f"stuck {name}", f"{name} is stuck to {{}} %", constants=(stuck_at,), **at),
        _make(OutputNoise, f"{name}.noise", f"noisier sensor of {name}", noisier, **noise),
    ]


def _of_input(item: Variable) -> list[Effect]:
    name, unit = item.name, item.unit
    at: dict[str, Any] = {"input": name, "location": name}
    in_unit = "" if unit == "1" else f" {unit}"
    times: dict[str, Any] = {**at, **TIMES}
    share = f"{{}} % more {name} than commanded", f"{{}} % less {name} than commanded"
    higher = f"{name} higher by {{}}{in_unit} than commanded", f"{name} lower by {{}}{in_unit} than commanded"
    follows = f"{name} follows its command with a time constant of {{}} min"
    later = f"{name} follows its command {{}} min later"
    sticks = f"{name} moves only for changes of more than {{}}{in_unit}"
    stiction: dict[str, Any] = {
        "unit": unit,
        "upper": LARGEST_SCALES * item.scale,
        "typical": 0.2 * item.scale,
        # thresholds that are tried
        "start_values": tuple(scales * item.scale for scales in (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)),
    }
    offset = {**_deviation(unit, item.scale), **at}
    return [
        _make(InputGain, f"{name}.gain", f"wrong gain of {name}", *share, **at),
        _make(InputOffset, f"{name}.offset", f"offset of {name}", *higher, **offset),
        _make(InputLag, f"{name}.lag", f"slow {name}", follows, **times),
        _make(InputDelay, f"{name}.delay", f"late {name}", later, **times),
        _make(InputStiction, f"{name}.stiction", f"sticking {name}", sticks, **stiction, **at),
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
    shown = item.unit if in_unit else "%"
    return _make(
        ParameterShift if in_unit else ParameterEffect,
        f"{item.name}.deviation",
        f"changed {item.name} ({item.meaning})" if item.meaning else f"changed {item.name}",
        f"{item.name} higher by {{}} {shown}",
        f"{item.name} lower by {{}} {shown}",
        location=parameter_location(model, item),
        parameter=item.name,
        unit=item.unit if in_unit else "1",
        lower=lower if in_unit else max(lower, -0.99),
        upper=upper if in_unit else min(upper, 4.0),  # five times the value
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
        f"unknown source in the balance of {item.name}",
        f"{{}} {item.unit}/min more into the balance of {item.name}",
        f"{{}} {item.unit}/min less into the balance of {item.name}",
        location=balance_of(item),
        state=item.name,
        **_deviation(f"{item.unit}/min", item.scale),
    )


class EffectChanges:
    """Changes that an effect makes in a model.

    Args:
        model: the process model.
        effect: an effect on it.

    Attributes:
        effect: the effect as given.
        n_states: number of states that the effect adds.
    """

    def __init__(self, model: ProcessModel, effect: Effect) -> None:
        self.effect, self._own = effect, model
        size = ca.SX.sym("m")
        self._extended = extended = effect.apply(model, size)
        self.n_states = len(extended.states) - len(model.states)
        x, u, p = extended.arguments()
        clock = [extended.clock.now, extended.clock.middle]
        resets = ca.vertcat(*(extended.resets.get(state.name, state.symbol) for state in extended.states))
        noise = (ca.SX(0) if item.noise_variance is None else item.noise_variance for item in extended.outputs)
        outputs = (*(item.expression for item in extended.outputs), *noise)
        shown = ca.vertcat(*extended.rhs, *outputs, resets, extended.time_offset)
        self._function = ca.Function("changed", [x, u, p, *clock, size], [ca.densify(shown)])
        self._slope = ca.Function("slope", [x, u, p, *clock, size], [ca.densify(ca.jacobian(shown, size))])

    @cached_property
    def slopes(self) -> Array:
        """Derivatives of everything by the size at the neutral size, in all points."""
        return np.concatenate([self._evaluate(self._slope, number, self.effect.neutral) for number in range(POINTS)])

    def at(self, size: float) -> Array:
        """Changes of everything from the neutral size to this one, in all points; shape (points, values)."""
        return np.array(
            [
                self._evaluate(self._function, number, size)
                - self._evaluate(self._function, number, self.effect.neutral)
                for number in range(POINTS)
            ]
        )

    def _evaluate(self, function: ca.Function, number: int, size: float) -> Array:
        rng = np.random.default_rng([1, number])
        u = [rng.uniform(item.lower, item.upper) for item in self._own.inputs]
        x = [rng.uniform(item.lower, item.upper) for item in self._own.states]
        x += rng.uniform(0.0, max(u, default=1.0), self.n_states).tolist()  # states of the effect
        return np.array(function(x, u, self._extended.values(), 0.0, 0.0, size)).ravel()


def are_twins(one: EffectChanges, other: EffectChanges) -> bool:
    """Return true if two effects do the same to a model at sizes that correspond."""
    a, b = one.effect, other.effect
    if one.n_states != other.n_states or a.is_discontinuous != b.is_discontinuous:
        return False
    factor = 1.0
    if not one.n_states and not a.is_discontinuous:
        square = float(other.slopes @ other.slopes)
        factor = float(one.slopes @ other.slopes) / square if square > 0.0 else 0.0
    usual = a.upper if a.is_discontinuous else a.typical
    sizes = [
        size
        for size in (usual, -usual, 0.4 * usual)
        if a.lower <= size <= a.upper and b.lower <= factor * size <= b.upper and factor != 0.0
    ]
    return bool(sizes) and all(_agree(one.at(size), other.at(factor * size)) for size in sizes)


def needs_moves(model: ProcessModel, effect: Effect, held: Mapping[str, float]) -> bool:
    """Return true if an effect changes nothing while inputs are held, and something where they are elsewhere or move.

    Args:
        model: the process model.
        effect: an effect on it; states that it adds are at rest.
        held: levels of the inputs that are held, by name.
    """
    extended, x, u = effect.apply(model, size := ca.SX.sym("m")), *model.arguments()[:2]
    added = [item.symbol for item in extended.states[len(model.states) :]]
    at_rest = [extended.at_rest[item.name] for item in extended.states[len(model.states) :]]
    shown = ca.vertcat(*extended.rhs[: len(model.states)], *(item.expression for item in extended.outputs))
    shown = ca.substitute(shown, ca.vertcat(*added), ca.vertcat(*at_rest)) if added else shown
    changed = ca.substitute(shown, size, effect.typical) - ca.substitute(shown, size, effect.neutral)
    fixed = ca.vertcat(*(item.symbol for item in model.inputs if item.name in held))
    levels = ca.vertcat(*(held[item.name] for item in model.inputs if item.name in held))
    symbols = [x, u, extended.arguments()[2], extended.clock.now, extended.clock.middle]
    function = ca.Function("changed", symbols, [ca.densify(ca.substitute(changed, fixed, levels)), ca.densify(changed)])
    for number in range(POINTS):
        rng = np.random.default_rng([2, number])
        point = ([rng.uniform(item.lower, item.upper) for item in items] for items in (model.states, model.inputs))
        then, elsewhere = (np.nan_to_num(np.array(item)) for item in function(*point, extended.values(), 0.0, 0.0))
        if np.any(np.abs(then) > 1e-9 * (1.0 + np.abs(elsewhere))):
            return False
        if not added and np.any(elsewhere):
            return True
    others = ca.vertcat(x, *(item.symbol for item in model.inputs if item.name not in held))
    follows = ca.vertcat(*at_rest) if added else ca.SX(0)
    return bool(ca.depends_on(follows, fixed)) and not ca.depends_on(follows, others)


@lru_cache(maxsize=64)
def add_generic(model: ProcessModel, own: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """Effects of a process's own, then the generic ones of its model that are no twins of one of them."""
    changes = [EffectChanges(model, effect) for effect in own]

    def has_twin(effect: Effect) -> bool:
        changed = EffectChanges(model, effect)
        return any(are_twins(other, changed) for other in changes)

    return (*own, *(effect for effect in generic_effects(model) if not has_twin(effect)))


@lru_cache(maxsize=64)
def hidden_sources(model: ProcessModel, effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """Unmodelled sources of a model, and flows between two balances; what only these explain is unknown.

    A source that an effect of the catalogue adds already is left out.
    """
    names = {effect.name for effect in effects}
    sources = (item for item in generic_effects(model) if isinstance(item, Source) and item.name not in names)
    alone = tuple(item for item in sources if not any(_adds_rate(model, effect, item) for effect in effects))
    return (*alone, *exchanges(model))


def _adds_rate(model: ProcessModel, effect: Effect, source: Source) -> bool:
    """Return true if an effect is a twin of a source; most act elsewhere, too, which is known without numbers."""
    size = ca.SX.sym("m")
    extended = effect.apply(model, size)
    acts = [ca.depends_on(item, size) for item in extended.rhs]
    alone = [name == source.state for name in model.state_names]
    shown = any(ca.depends_on(item.expression, size) for item in extended.outputs)
    return acts == alone and not shown and are_twins(EffectChanges(model, effect), EffectChanges(model, source))


def _agree(one: Array, other: Array) -> bool:
    finite = np.all(np.isfinite(one), axis=1) & np.all(np.isfinite(other), axis=1)
    if not np.any(finite):
        return False
    one, other = one[finite], other[finite]
    size = np.max(np.abs(one), axis=0)
    return bool(np.any(size)) and bool(np.all(np.abs(one - other) <= 1e-6 * size + 1e-12))  # of the change
