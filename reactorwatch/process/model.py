"""A process model: balances as symbolic expressions, parameters with units and bounds.

Everything else is derived from it: trajectories, steady states, linear models, and the model with an effect in it,
which is again a `ProcessModel`.

Time is in minutes. The right-hand side may depend on it through the profiles of effects. Where an effect sets in at
once, the right-hand side jumps, and an integrator that steps across the jump loses its order. So such an expression
compares its onset with `Clock.middle`, the middle of the integration step, and never with `Clock.now`, which takes both
sides within one step; and the onset is listed in `breakpoints`, where the integrator ends its step.

Some states are added by effects: a valve's lag, the vessel's wall. They are not measured and no initial value is given;
the model computes it from the other states and the inputs (`at_rest`). Some states jump when a row begins and the input
may have changed, such as a valve that sticks (`resets`).
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import blake2b
from typing import Protocol, runtime_checkable

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array

MODEL_CACHE_SIZE = 64
"""Number of models whose functions are cached: a diagnosis fits some sixty."""


@dataclass(frozen=True, eq=False)
class Variable:
    """A state or an input.

    Attributes:
        name: symbol of the variable in the literature.
        unit: unit of its values.
        lower: smallest value that makes physical sense.
        upper: largest value that makes physical sense.
        scale: a typical magnitude of its changes; tolerances are relative to it.
        meaning: a short description.
        symbol: symbol of the variable in the expressions.
        balance: location of the balance that a state's equation is; empty: none.
        usual: usual value of an input; None: unknown.
    """

    name: str
    unit: str
    lower: float
    upper: float
    scale: float
    meaning: str
    symbol: ca.SX
    balance: str = ""
    usual: float | None = None


@dataclass(frozen=True, eq=False)
class Parameter:
    """A constant of the equations; attributes as for `Variable`, and `value`, its nominal value."""

    name: str
    value: float
    unit: str
    lower: float
    upper: float
    meaning: str
    symbol: ca.SX


@dataclass(frozen=True, eq=False)
class Output:
    """A measured quantity.

    Attributes:
        name: name of the quantity.
        unit: unit of its values.
        expression: expression of states, inputs, parameters and time.
        noise_variance: variance of its sensor's noise beyond the usual, an expression of inputs, parameters and time;
            None: there is none.
    """

    name: str
    unit: str
    expression: ca.SX
    noise_variance: ca.SX | None = None


@dataclass(frozen=True, eq=False)
class Clock:
    """Symbols of time, in minutes: now, and the middle of the integration step that contains it."""

    now: ca.SX
    middle: ca.SX


@dataclass(frozen=True)
class Place:
    """A part of a process in which something unknown may act.

    Attributes:
        name: name of the place, unique in its process.
        location: location in a diagnosis; several places may share one.
        kind: kind of the correction, see `reactorwatch.process.law`.
        of: state, input, parameter or output that is corrected; empty for a factor.
        flows: for a factor, the name of the model's term in each balance, by state.
        variables: states, inputs and terms that the correction may depend on, the likeliest first.
        lag_min: time constant in minutes with which the correction follows its variables; 0: at once.
        apart: a place whose correction may act here as well, such as another heat of reaction; empty: none.
    """

    name: str
    location: str
    kind: str
    of: str = ""
    flows: Mapping[str, str] = field(default_factory=dict)
    variables: tuple[str, ...] = ()
    lag_min: float = 0.0
    apart: str = ""


@runtime_checkable
class Extension(Protocol):
    """Addition to the equations of a model: an effect, a law, or a controller in continuous time."""

    def extend(self, model: "ProcessModel") -> "ProcessModel":
        """Copy of the model with the extension; a ValueError if the model lacks what it acts on."""


def variable(
    name: str,
    unit: str,
    bounds: tuple[float, float],
    scale: float,
    meaning: str,
    balance: str = "",
    usual: float | None = None,
) -> Variable:
    """Make a variable with a new symbol."""
    return Variable(name, unit, *bounds, scale, meaning, ca.SX.sym(name), balance, usual)


def parameter(name: str, value: float, unit: str, bounds: tuple[float, float], meaning: str) -> Parameter:
    """Make a parameter with a new symbol.

    Raises:
        ValueError: its value is outside its bounds.
    """
    _check_bounds(name, value, *bounds)
    return Parameter(name, value, unit, *bounds, meaning, ca.SX.sym(name))


def new_clock() -> Clock:
    """Make the clock of a new model."""
    return Clock(ca.SX.sym("t"), ca.SX.sym("t_middle"))


@dataclass(frozen=True, eq=False)
class ProcessModel:
    """A process: dx/dt = rhs(x, u, p, t), y = outputs(x, u, p, t); t in minutes.

    Attributes:
        name: name of the process.
        states: x.
        inputs: u; held constant between samples.
        parameters: p.
        rhs: dx/dt, one expression a state, in the state's unit per minute.
        outputs: y.
        clock: the symbols of time.
        breakpoints: names of the parameters, in minutes, that are times at which `rhs` jumps or has a kink.
        terms: parts of the balances that effects act on or need, by name, as they appear in `rhs`.
        at_rest: equilibrium of a state at given other states, inputs and parameters, by name of the state.
        resets: new value of a state when a row begins, from the states before and the new inputs, by name of the state.
        time_offset: minutes by which the clock is ahead of the states; while it grows, the states' time step is
            shorter.
        places: where something unknown may act; empty: they follow from the equations (`process.law`).
        laws: laws of what was unknown, which are part of the equations already.
        effects: effects of its own; None: those of the catalogue under its name.
        uncertain: what a filter of this model estimates beside the states, see `kalman.filter_states`; no part of
            the equations.
    """

    name: str
    states: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    parameters: tuple[Parameter, ...]
    rhs: tuple[ca.SX, ...]
    outputs: tuple[Output, ...]
    clock: Clock
    breakpoints: tuple[str, ...] = ()
    terms: Mapping[str, ca.SX] = field(default_factory=dict)
    at_rest: Mapping[str, ca.SX] = field(default_factory=dict)
    resets: Mapping[str, ca.SX] = field(default_factory=dict)
    time_offset: ca.SX = field(default_factory=lambda: ca.SX(0))
    places: tuple[Place, ...] = ()
    laws: tuple[Extension, ...] = ()
    effects: tuple[Extension, ...] | None = None
    uncertain: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.states:
            raise ValueError("equations must have at least one state, got none; leave them out, and they are learned")
        if len(self.rhs) != len(self.states):
            raise ValueError(f"rhs must have one expression a state, {len(self.states)}, got {len(self.rhs)}")
        count = Counter((*self.state_names, *self.input_names, *self.parameter_names))
        twice = sorted(name for name, times in count.items() if times > 1)
        if twice:
            raise ValueError(f"names in a model must differ, got {', '.join(twice)} more than once")

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states."""
        return tuple(state.name for state in self.states)

    @property
    def units(self) -> dict[str, str]:
        """Units of the inputs and outputs, by name."""
        return {item.name: item.unit for item in self.inputs} | {item.name: item.unit for item in self.outputs}

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(item.name for item in self.inputs)

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return tuple(output.name for output in self.outputs)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(item.name for item in self.parameters)

    @cached_property
    def constant_states(self) -> tuple[int, ...]:
        """Indices of the states in `at_rest` that neither flow nor jump: unknown constants."""
        return tuple(
            i
            for i, (state, rate) in enumerate(zip(self.states, self.rhs, strict=True))
            if rate.is_zero() and state.name in self.at_rest and state.name not in self.resets
        )

    def parameter(self, name: str) -> Parameter:
        """Parameter by name; a ValueError if there is none."""
        self._check_name("parameter", name, self._indices)
        return self.parameters[self._indices[name]]

    def values(self, changes: Mapping[str, float] | None = None) -> Array:
        """Parameter values, shape (n_p,): nominal except for the changes.

        Raises:
            ValueError: a change names no parameter, or lies outside its bounds.
        """
        values = self._nominal.copy()
        for name, value in (changes or {}).items():
            item = self.parameter(name)
            _check_bounds(name, value, item.lower, item.upper)
            values[self._indices[name]] = value
        return values

    @cached_property
    def _nominal(self) -> Array:
        return np.array([item.value for item in self.parameters], dtype=float)

    @cached_property
    def _indices(self) -> dict[str, int]:
        """Indices of the parameters, by name."""
        return {name: i for i, name in enumerate(self.parameter_names)}

    def with_values(self, changes: Mapping[str, float]) -> "ProcessModel":
        """Copy with other nominal values; a ValueError as in `values`."""
        if not changes:
            return self
        values = zip(self.parameters, self.values(changes).tolist(), strict=True)
        parameters = (replace(item, value=value) if item.name in changes else item for item, value in values)
        return replace(self, parameters=tuple(parameters))

    def term(self, name: str) -> ca.SX:
        """Part of the balances by name; a ValueError if there is none."""
        self._check_name("term", name, self.terms)
        return self.terms[name]

    def substitute(self, symbol: ca.SX, expression: ca.SX) -> "ProcessModel":
        """Copy with the symbol of a parameter or input replaced by an expression."""
        return self._map_expressions(lambda items: ca.substitute(items, [symbol], [expression]))

    def add_rate(self, state: str, rate: ca.SX) -> "ProcessModel":
        """Copy with a further rate in the balance of a state; a ValueError if there is no such state."""
        index = self.state_index(state)
        return replace(self, rhs=tuple(item + rate if i == index else item for i, item in enumerate(self.rhs)))

    def state_index(self, name: str) -> int:
        """Index of a state by name; a ValueError if there is none."""
        self._check_name("state", name, self.state_names)
        return self.state_names.index(name)

    def state(self, name: str) -> ca.SX:
        """Symbol of a state by name; a ValueError if there is none."""
        return self.states[self.state_index(name)].symbol

    def output(self, name: str) -> Output:
        """Output by name; a ValueError if there is none."""
        self._check_name("output", name, self.output_names)
        return self.outputs[self.output_names.index(name)]

    def _check_name(self, kind: str, name: str, names: Collection[str]) -> None:
        if name not in names:
            raise ValueError(f"{self.name} has no {kind} {name!r} (it has {', '.join(names) or 'none'})")

    def with_output(self, output: Output) -> "ProcessModel":
        """Copy with another output in place of that of its name."""
        return replace(self, outputs=tuple(output if item.name == output.name else item for item in self.outputs))

    def expressions(self) -> list[ca.SX]:
        """Rates, outputs, `time_offset`, then the terms, equilibria and new values, each in their order."""
        named = (*self.terms.values(), *self.at_rest.values(), *self.resets.values())
        return [*self.rhs, *(output.expression for output in self.outputs), self.time_offset, *named]

    def with_expressions(self, expressions: Iterable[ca.SX]) -> "ProcessModel":
        """Copy with other expressions, in the order of `expressions`."""
        items = iter(expressions)
        return replace(
            self,
            rhs=tuple(next(items) for _ in self.rhs),
            outputs=tuple(replace(output, expression=next(items)) for output in self.outputs),
            time_offset=next(items),
            terms={name: next(items) for name in self.terms},
            at_rest={name: next(items) for name in self.at_rest},
            resets={name: next(items) for name in self.resets},
        )

    def _map_expressions(self, change: Callable[[list[ca.SX]], list[ca.SX]]) -> "ProcessModel":
        """Copy with all expressions changed."""
        noisy = [item.noise_variance for item in self.outputs if item.noise_variance is not None]
        changed = iter(change([*self.expressions(), *noisy]))
        model = self.with_expressions(changed)
        outputs = (
            item if item.noise_variance is None else replace(item, noise_variance=next(changed))
            for item in model.outputs
        )
        return replace(model, outputs=tuple(outputs))

    def with_state(self, state: Variable, rate: ca.SX, at_rest: ca.SX, reset: ca.SX | None = None) -> "ProcessModel":
        """Copy with a further state, the last, with its balance; `at_rest` and `reset` are as in `ProcessModel`."""
        return replace(
            self,
            states=(*self.states, state),
            rhs=(*self.rhs, rate),
            at_rest={**self.at_rest, state.name: at_rest},
            resets=self.resets if reset is None else {**self.resets, state.name: reset},
        )

    def rest_expressions(self) -> tuple[ca.SX, ...]:
        """All states as expressions of those that are not in `at_rest`."""
        resting = [state for state in self.states if state.name in self.at_rest]
        symbols, rest = [state.symbol for state in resting], [self.at_rest[state.name] for state in resting]
        result = [self.at_rest.get(state.name, state.symbol) for state in self.states]
        # an equilibrium may depend on another
        while resting and ca.depends_on(ca.vertcat(*result), ca.vertcat(*symbols)):
            result = ca.substitute(result, symbols, rest)
        return tuple(result)

    @cached_property
    def without_effect_states(self) -> "ProcessModel":
        """Model of the states that are not in `at_rest`, with all others in equilibrium."""
        if not self.at_rest:
            return self
        symbols, rest = [state.symbol for state in self.states], list(self.rest_expressions())
        resting = self._map_expressions(lambda items: ca.substitute(items, symbols, rest))
        kept = [i for i, state in enumerate(self.states) if state.name not in self.at_rest]
        return replace(
            resting,
            states=tuple(self.states[i] for i in kept),
            rhs=tuple(resting.rhs[i] for i in kept),
            at_rest={},
            resets={},
        )

    def function(self, name: str = "model") -> ca.Function:
        """The model as a CasADi function (x, u, p, t, t_middle) -> (dx/dt, y)."""
        return ca.Function(
            name,
            [*self.arguments(), self.clock.now, self.clock.middle],
            [ca.vertcat(*self.rhs), ca.vertcat(*(output.expression for output in self.outputs))],
            ["x", "u", "p", "t", "t_middle"],
            ["rhs", "y"],
        )

    def noise_function(self) -> ca.Function | None:
        """Variances of the sensors' noise beyond the usual, (u, p, t) -> (n_y,); None: there are none."""
        if all(output.noise_variance is None for output in self.outputs):
            return None
        beyond = [ca.SX(0) if item.noise_variance is None else item.noise_variance for item in self.outputs]
        _, u, p, t, variances = self.at_one_time(ca.vertcat(*beyond))
        return ca.Function("noise", [u, p, t], [ca.densify(variances)])

    def arguments(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Symbols of states, inputs and parameters as three column vectors."""
        return (
            ca.vertcat(*(state.symbol for state in self.states)),
            ca.vertcat(*(item.symbol for item in self.inputs)),
            ca.vertcat(*(item.symbol for item in self.parameters)),
        )

    def at_one_time(self, expression: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        """Symbols x, u, p and t, and an expression in terms of them: at t, for both symbols of the clock."""
        t = ca.SX.sym("t")
        (result,) = ca.substitute([expression], [self.clock.now, self.clock.middle], [t, t])
        return *self.arguments(), t, result

    def output_expressions(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        """Symbols x, u, p and t, and the outputs in terms of them."""
        return self.at_one_time(ca.vertcat(*(output.expression for output in self.outputs)))


def fingerprint(model: ProcessModel) -> str:
    """Digest of a model's equations, names and numbers."""
    x, u, p = model.arguments()
    memory = [*model.at_rest.values(), *model.resets.values()]
    function = ca.Function("memory", [x, u, p], memory, {"allow_free": True})
    words = (model.name, *model.state_names, *model.input_names, *model.output_names, *model.parameter_names)
    texts = (*words, *model.breakpoints, *model.at_rest, *model.resets, model.function().serialize())
    values = model.values().tobytes()
    return blake2b("\0".join((*texts, function.serialize())).encode() + values, digest_size=16).hexdigest()


def _check_bounds(name: str, value: float, lower: float, upper: float) -> None:
    if not lower <= value <= upper:
        raise ValueError(f"{name} must be in [{lower:g}, {upper:g}], got {value:g}")
