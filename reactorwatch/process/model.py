"""A process, said once: its balances as symbolic expressions, its parameters with units and bounds.

Everything else is derived from this: trajectories and their exact sensitivities, steady states, linear models, and
the model with an effect in it, which is again a `ProcessModel`.

Time is in minutes. The right-hand side may depend on it through effects that come and go. Where an effect sets in
at once, the right-hand side jumps, and an integrator that steps across the jump loses its order. So such an
expression compares its onset with `Clock.middle`, the middle of the integration step, and never with `Clock.now`,
which within one step takes both sides; and the onset is listed in `breakpoints`, where the integrator ends its step.

Some states are not the process's own but memory that an effect brings along: a valve that lags, the wall of the vessel.
Nobody measures them and nobody says where they begin, so the model does: in `at_rest`, by the other states and the
inputs. And some do not flow but jump, at the moment at which a row of a record begins and the input may have changed: a
valve that sticks. Those are in `resets`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array


@dataclass(frozen=True, eq=False)
class Variable:
    """A state or an input.

    Attributes:
        name: as the field writes it.
        unit: of its values.
        lower: smallest value that makes physical sense.
        upper: largest value that makes physical sense.
        scale: a typical magnitude of its changes; tolerances are relative to it.
        meaning: a few words for people.
        symbol: stands for it in the expressions.
        balance: of a state whose equation is the balance of something, the place in the plant that this is (one of
            `process.effect.LOCATIONS`); else empty.
    """

    name: str
    unit: str
    lower: float
    upper: float
    scale: float
    meaning: str
    symbol: ca.SX
    balance: str = ""


@dataclass(frozen=True, eq=False)
class Parameter:
    """A number in the equations. Attributes as for `Variable`; `value` is its nominal value."""

    name: str
    value: float
    unit: str
    lower: float
    upper: float
    meaning: str
    symbol: ca.SX


@dataclass(frozen=True, eq=False)
class Output:
    """What is measured, as an expression of states, inputs and parameters."""

    name: str
    unit: str
    expression: ca.SX


@dataclass(frozen=True, eq=False)
class Clock:
    """Time in the expressions, in minutes: now, and the middle of the integration step that now lies in."""

    now: ca.SX
    middle: ca.SX


def variable(
    name: str, unit: str, bounds: tuple[float, float], scale: float, meaning: str, balance: str = ""
) -> Variable:
    """A variable with a symbol of its own."""
    return Variable(name, unit, *bounds, scale, meaning, ca.SX.sym(name), balance)


def parameter(name: str, value: float, unit: str, bounds: tuple[float, float], meaning: str) -> Parameter:
    """A parameter with a symbol of its own.

    Raises:
        ValueError: its value is outside its bounds.
    """
    _check_bounds(name, value, *bounds)
    return Parameter(name, value, unit, *bounds, meaning, ca.SX.sym(name))


def new_clock() -> Clock:
    """A clock for a new model."""
    return Clock(ca.SX.sym("t"), ca.SX.sym("t_middle"))


@dataclass(frozen=True, eq=False)
class ProcessModel:
    """A process: dx/dt = rhs(x, u, p, t), y = outputs(x, u, p, t); t in minutes.

    Attributes:
        name: of the process.
        states: x.
        inputs: u; held constant between samples.
        parameters: p.
        rhs: dx/dt, one expression a state, in the state's unit per minute.
        outputs: y.
        clock: the symbols that stand for time.
        breakpoints: names of the parameters, in minutes, that are times at which `rhs` jumps or has a kink.
        terms: parts of the balances that effects act on or need, by name, as they stand in `rhs`.
        at_rest: by name of a state, where it rests while the other states, inputs and parameters are what they are.
        resets: by name of a state, what it becomes when a row begins: of the states before and the inputs from then on.
        clock_ahead: by how many minutes the clock is ahead of the states; while that grows, they go on for less.
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
    clock_ahead: ca.SX = field(default_factory=lambda: ca.SX(0))

    def __post_init__(self) -> None:
        if len(self.rhs) != len(self.states):
            raise ValueError(f"rhs must have one expression a state, {len(self.states)}, got {len(self.rhs)}")
        names = [*self.state_names, *self.input_names, *self.parameter_names]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"names in a model must differ, got {', '.join(twice)} more than once")

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return tuple(state.name for state in self.states)

    @property
    def units(self) -> dict[str, str]:
        """The units of its inputs and outputs, by name."""
        return {item.name: item.unit for item in self.inputs} | {item.name: item.unit for item in self.outputs}

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs, in order."""
        return tuple(item.name for item in self.inputs)

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs, in order."""
        return tuple(output.name for output in self.outputs)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(item.name for item in self.parameters)

    @cached_property
    def lasting(self) -> tuple[int, ...]:
        """Places of the states in `at_rest` that neither flow nor jump: numbers that hold, though nobody knows them."""
        return tuple(
            place
            for place, (state, rate) in enumerate(zip(self.states, self.rhs, strict=True))
            if rate.is_zero() and state.name in self.at_rest and state.name not in self.resets
        )

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name.

        Raises:
            ValueError: there is none.
        """
        if name not in self._places:
            raise ValueError(f"{self.name} has no parameter {name!r} (it has {', '.join(self.parameter_names)})")
        return self.parameters[self._places[name]]

    def values(self, changes: Mapping[str, float] | None = None) -> Array:
        """The parameters' values, shape (n_p,): nominal, but for the changes.

        Raises:
            ValueError: a change names no parameter, or lies outside its bounds.
        """
        values = self._nominal.copy()
        for name, value in (changes or {}).items():
            item = self.parameter(name)
            _check_bounds(name, value, item.lower, item.upper)
            values[self._places[name]] = value
        return values

    @cached_property
    def _nominal(self) -> Array:
        return np.array([item.value for item in self.parameters], dtype=float)

    @cached_property
    def _places(self) -> dict[str, int]:
        """Of the parameters."""
        return {name: place for place, name in enumerate(self.parameter_names)}

    def with_values(self, changes: Mapping[str, float]) -> "ProcessModel":
        """The same model with other nominal values.

        Raises:
            ValueError: as `values`.
        """
        if not changes:
            return self
        values = self.values(changes)
        return replace(
            self,
            parameters=tuple(
                replace(item, value=float(value)) for item, value in zip(self.parameters, values, strict=True)
            ),
        )

    def term(self, name: str) -> ca.SX:
        """The part of the balances of that name.

        Raises:
            ValueError: there is none.
        """
        if name not in self.terms:
            raise ValueError(f"{self.name} has no term {name!r} (it has {', '.join(self.terms) or 'none'})")
        return self.terms[name]

    def substitute(self, symbol: ca.SX, expression: ca.SX) -> "ProcessModel":
        """The same model with the symbol of a parameter or input replaced wherever it stands by an expression."""
        return self._mapped(lambda items: ca.substitute(items, [symbol], [expression]))

    def added_to(self, state: str, rate: ca.SX) -> "ProcessModel":
        """The same model with a further rate in the balance of a state.

        Raises:
            ValueError: there is no such state.
        """
        index = self.state_index(state)
        return replace(self, rhs=tuple(item + rate if place == index else item for place, item in enumerate(self.rhs)))

    def state_index(self, name: str) -> int:
        """The place of the state of that name.

        Raises:
            ValueError: there is none.
        """
        if name not in self.state_names:
            raise ValueError(f"{self.name} has no state {name!r} (it has {', '.join(self.state_names)})")
        return self.state_names.index(name)

    def _mapped(self, change: Callable[[list[ca.SX]], list[ca.SX]]) -> "ProcessModel":
        """The same model with all its expressions changed."""
        shown = [output.expression for output in self.outputs]
        named = (self.terms, self.at_rest, self.resets)
        of_states = (item for items in named for item in items.values())
        changed = iter(change([*self.rhs, *shown, self.clock_ahead, *of_states]))
        return replace(
            self,
            rhs=tuple(next(changed) for _ in self.rhs),
            outputs=tuple(replace(output, expression=next(changed)) for output in self.outputs),
            clock_ahead=next(changed),
            terms={name: next(changed) for name in self.terms},
            at_rest={name: next(changed) for name in self.at_rest},
            resets={name: next(changed) for name in self.resets},
        )

    def with_state(self, state: Variable, rate: ca.SX, at_rest: ca.SX, reset: ca.SX | None = None) -> "ProcessModel":
        """The same model with a further state.

        Args:
            state: behind the others.
            rate: its balance.
            at_rest: see `ProcessModel`.
            reset: likewise; None: it does not jump.
        """
        return replace(
            self,
            states=(*self.states, state),
            rhs=(*self.rhs, rate),
            at_rest={**self.at_rest, state.name: at_rest},
            resets=self.resets if reset is None else {**self.resets, state.name: reset},
        )

    def at_rest_states(self) -> tuple[ca.SX, ...]:
        """All states as expressions of those that are not in `at_rest`."""
        resting = [state for state in self.states if state.name in self.at_rest]
        symbols, where = [state.symbol for state in resting], [self.at_rest[state.name] for state in resting]
        found = [self.at_rest.get(state.name, state.symbol) for state in self.states]
        while resting and ca.depends_on(ca.vertcat(*found), ca.vertcat(*symbols)):  # one may rest where another does
            found = ca.substitute(found, symbols, where)
        return tuple(found)

    def without_memory(self) -> "ProcessModel":
        """The model of the states that are not in `at_rest`, while all others are at rest."""
        if not self.at_rest:
            return self
        symbols, rest = [state.symbol for state in self.states], list(self.at_rest_states())
        resting = self._mapped(lambda items: ca.substitute(items, symbols, rest))
        own = [place for place, state in enumerate(self.states) if state.name not in self.at_rest]
        return replace(
            resting,
            states=tuple(self.states[place] for place in own),
            rhs=tuple(resting.rhs[place] for place in own),
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

    def arguments(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """The symbols of states, inputs and parameters as three column vectors."""
        return (
            ca.vertcat(*(state.symbol for state in self.states)),
            ca.vertcat(*(item.symbol for item in self.inputs)),
            ca.vertcat(*(item.symbol for item in self.parameters)),
        )

    def shown(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        """The symbols x, u, p and of the time, and the outputs in terms of them."""
        x, u, p = self.arguments()
        t, y = ca.SX.sym("t"), ca.vertcat(*(output.expression for output in self.outputs))
        return x, u, p, t, ca.substitute(ca.substitute(y, self.clock.now, t), self.clock.middle, t)


def _check_bounds(name: str, value: float, lower: float, upper: float) -> None:
    if not lower <= value <= upper:
        raise ValueError(f"{name} must be in [{lower:g}, {upper:g}], got {value:g}")
