"""A process: its signals with their roles and, if there are any, equations, effects and controllers."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, get_args

import msgspec

from reactorwatch.errors import InputError, describe_exception, describe_unknown, prefix_errors
from reactorwatch.process import OPERATIONS, own_effects
from reactorwatch.process.effect import Effect
from reactorwatch.process.extended_model import store_equations
from reactorwatch.process.generic import add_generic, generic_effects
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.operation import Operation, WatchDefaults
from reactorwatch.records.file_format import FileFormat
from reactorwatch.units import conversion

Role = Literal["input", "output", "setpoint", "mode", "label"]

ROLES: tuple[str, ...] = get_args(Role)


@dataclass(frozen=True)
class Signal:
    """A measured quantity.

    Attributes:
        name: name on the bus, in settings and in reports.
        unit: unit of its values; empty: unknown.
        role: `input` acts on the process, `output` is watched, `setpoint` is what a controller aims at, `mode` says how
            the process is operated, `label` is carried along and not watched.
        column: name or number (from 1) of its column in a file; None: its name.
        resolution: smallest step between two of its values, in its unit; None: learned from data.
        bounds: lowest and highest value that it can have, in its unit; other values are not measured values, and an
            input at a bound is saturated; None: unknown.

    Raises:
        InputError: the role is unknown, the resolution is not positive, or the bounds do not increase.
    """

    name: str
    unit: str = ""
    role: str = "output"
    column: str | int | None = None
    resolution: float | None = None
    bounds: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.name or self.name != self.name.strip() or "/" in self.name:
            raise InputError(f"name of a signal must be a text without '/' and blanks around it, got {self.name!r}")
        if self.role not in ROLES:
            raise InputError(f"signal {self.name!r}: role must be one of {', '.join(ROLES)}, got {self.role!r}")
        if self.resolution is not None and not 0 < self.resolution < float("inf"):
            raise InputError(
                f"signal {self.name!r}: resolution must be a positive number of its unit, got {self.resolution:g}; "
                "leave it out, and it is learned"
            )
        if self.bounds is not None and not self.bounds[0] < self.bounds[1]:
            raise InputError(
                f"signal {self.name!r}: bounds must be a lower and a higher number, got {list(self.bounds)}"
            )


class KnownParameter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A constant of the equations with its uncertainty.

    Attributes:
        value: the value.
        sd: standard deviation of the value, in the same unit; 0: it is exact.
        unit: unit of both.
    """

    value: float
    sd: float = 0.0
    unit: str = ""

    @classmethod
    def of(cls, given: "KnownParameter | tuple[float, float, str]") -> "KnownParameter":
        """Make one of a tuple (value, sd, unit), which is another way to write it."""
        return given if isinstance(given, KnownParameter) else cls(*given)


@dataclass(frozen=True)
class Process:
    """A process as a user describes it.

    Attributes:
        name: name of the process.
        signals: the signals, each name once; at least one of them an output.
        equations: the model, in the units of the equations; None: it is learned from data.
        effects: what can be named as a cause and injected as a fault.
        controllers: controllers of its inputs, for a simulation (see `reactorwatch.process.operation`).
        parameters: constants of the equations that are given, by name: value, standard deviation and unit.
        file_format: statements on how to read its files; the rest is guessed for each file.
        operation: levels of its inputs, noise of its sensors and named runs, for a simulation.
        generic: whether effects made from its equations are possible causes beside its own (`causes`).
        watch: settings of its watch where none are stated.

    Raises:
        InputError: a rule above is broken, or signals and equations do not fit.
    """

    name: str
    signals: tuple[Signal, ...]
    equations: ProcessModel | None = None
    effects: tuple[Effect, ...] = ()
    controllers: tuple[object, ...] = ()
    parameters: Mapping[str, KnownParameter | tuple[float, float, str]] = field(default_factory=dict)
    file_format: FileFormat = field(default_factory=FileFormat)
    operation: Operation = field(default_factory=Operation)
    generic: bool = False
    watch: WatchDefaults = field(default_factory=WatchDefaults)

    def __post_init__(self) -> None:
        if not self.name:
            raise InputError("name of a process must be a text of at least one letter, got ''")
        self._check_signals()
        if self.equations is None:
            if self.parameters or self.effects or self.generic:
                raise InputError(
                    f"process {self.name!r}: parameters and effects, generic ones too, need equations, got none; "
                    "name them, or leave these out"
                )
            return
        self._check_equations(self.equations)

    def names(self, role: str) -> tuple[str, ...]:
        """Names of the signals of a role, in their order."""
        return tuple(signal.name for signal in self.signals if signal.role == role)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.names("input")

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.names("output")

    @property
    def units(self) -> dict[str, str]:
        """Known units by name of the signal."""
        return {signal.name: signal.unit for signal in self.signals if signal.unit}

    @cached_property
    def model(self) -> ProcessModel | None:
        """The equations with the given parameters and the effects; None: the process has no equations."""
        if self.equations is None:
            return None
        given = {name: item.value for name, item in self._parameters_in_model_units.items()}
        model = self.equations.with_values(given)
        return model if own_effects(model) == tuple(self.effects) else replace(model, effects=tuple(self.effects))

    @cached_property
    def causes(self) -> tuple[Effect, ...]:
        """Effects with which it is diagnosed: its own or, if there are none, those made from its equations.

        With `generic`, its own, then those made from its equations that do not do the same.
        """
        if self.model is None:
            return ()
        if not self.effects:
            return generic_effects(self.model)
        return add_generic(self.model, tuple(self.effects)) if self.generic else self.effects

    @cached_property
    def faults(self) -> tuple[Effect, ...]:
        """Effects that can be injected: its own, and those made from its equations under other names."""
        if self.model is None:
            return ()
        names = {effect.name for effect in self.effects}
        return (*self.effects, *(effect for effect in generic_effects(self.model) if effect.name not in names))

    def select_causes(self, without: Sequence[str] = ()) -> tuple[Effect, ...]:
        """Causes but for some, by name; none is replaced by a generic one that does the same.

        Raises:
            InputError: a name is no cause of this process.
        """
        names = [effect.name for effect in self.causes]
        for name in without:
            if name not in names:
                raise InputError(f"process {self.name!r}: {describe_unknown('cause', name, names)}")
        return tuple(effect for effect in self.causes if effect.name not in without)

    def without_equations(self) -> "Process":
        """Copy with the signals alone."""
        return replace(self, equations=None, effects=(), controllers=(), parameters={}, generic=False)

    def require_model(self, kind: type[InputError] = InputError) -> ProcessModel:
        """The model.

        Args:
            kind: kind of the error.

        Raises:
            InputError: the process has no equations.
        """
        if self.model is None:
            raise kind(
                f"process {self.name!r}: must have equations for this, got none; name those of the catalogue with "
                'equations = "NAME", or write them in a .py file'
            )
        return self.model

    @property
    def uncertain(self) -> dict[str, float]:
        """Standard deviations of the parameters that are not exact, by name, in the units of the equations."""
        return {name: item.sd for name, item in self._parameters_in_model_units.items() if item.sd > 0}

    @cached_property
    def _parameters_in_model_units(self) -> dict[str, KnownParameter]:
        """Given parameters in the units of the equations."""
        known = {}
        for name, given in self.parameters.items():
            assert self.equations is not None
            item, what = KnownParameter.of(given), f"process {self.name!r}, parameter {name!r}"
            if not item.sd >= 0:
                raise InputError(f"{what}: sd must be at least 0, got {item.sd:g}")
            with prefix_errors(f"process {self.name!r}", ValueError):
                unit = self.equations.parameter(name).unit
            if item.unit and item.unit != unit:
                scale, offset = _convert(item.unit, unit, what)
                item = KnownParameter(scale * item.value + offset, scale * item.sd, unit)
            known[name] = item
        return known

    def _check_signals(self) -> None:
        names: list[str | int] = [signal.name for signal in self.signals]
        for what, values in (
            ("name", names),
            ("column", [signal.name if signal.column is None else signal.column for signal in self.signals]),
        ):
            twice = next((value for value, times in Counter(values).items() if times > 1), None)
            if twice is not None:
                owners = [
                    f"{s.name} ({s.role})" for s, value in zip(self.signals, values, strict=True) if value == twice
                ]
                raise InputError(
                    f"process {self.name!r}: each signal must have a {what} of its own, got {twice!r} for "
                    f"{' and '.join(owners)}; leave one out"
                )
        if not self.outputs:
            raise InputError(
                f"process {self.name!r}: at least one signal must be an output, got "
                f"{', '.join(f'{s.name} ({s.role})' for s in self.signals) or 'no signals'}"
            )

    def _check_equations(self, model: ProcessModel) -> None:
        for role, given, needed in (
            ("input", self.inputs, model.input_names),
            ("output", self.outputs, model.output_names),
        ):
            missing = [name for name in needed if name not in given]
            if missing:
                raise InputError(
                    f"process {self.name!r}: its equations need the {role} {missing[0]!r}, got the {role}s "
                    f"{', '.join(given) or 'none'}; add it, with column = ... if the file names it otherwise"
                )
        for signal in self.signals:
            if signal.unit and signal.name in model.units:
                _convert(signal.unit, model.units[signal.name], f"process {self.name!r}, signal {signal.name!r}")
        try:
            extended = self.model
        except InputError:  # it names the process
            raise
        except ValueError as error:
            raise InputError(f"process {self.name!r}: {error}") from error
        assert extended is not None
        if extended.effects is not None:  # its equations may be code of the user
            _check_expressions(self.name, extended)
        for effect in own_effects(extended) if extended.effects is not None else ():
            _check_effect(self.name, effect, extended)


def _convert(unit: str, wanted: str, name: str) -> tuple[float, float]:
    """Conversion of a unit, see `conversion`; an error says what to correct."""
    try:
        return conversion(unit, wanted, name)
    except InputError as error:
        raise InputError(f"{error}; correct the unit in the description") from error


def _check_expressions(process: str, model: ProcessModel) -> None:
    """Check that the equations are expressions of a model's own symbols."""
    try:
        store_equations(model)
    except ValueError as error:
        known = ", ".join((*model.state_names, *model.input_names, *model.parameter_names))
        raise InputError(
            f"process {process!r}: {error}; write them with its states, inputs and parameters ({known})"
        ) from error


def _check_effect(process: str, effect: Effect, model: ProcessModel) -> None:
    """Check that an effect, which may be code of the user, fits a model."""
    try:
        effect.extend(model)
    except Exception as error:
        name = getattr(effect, "name", type(effect).__name__)
        raise InputError(
            f"process {process!r}, effect {name!r}: must extend the equations, got {describe_exception(error)}"
        ) from error


def describe_model(model: ProcessModel) -> Process:
    """Describe a model: each input and output is a signal of its name, with its unit; the rest is of the catalogue."""
    signals = (
        *(Signal(item.name, item.unit, "input") for item in model.inputs),
        *(Signal(item.name, item.unit, "output") for item in model.outputs),
    )
    operation = OPERATIONS.get(model.name, Operation())
    return Process(
        model.name,
        signals,
        model,
        own_effects(model),
        operation.controllers,
        operation=operation,
        watch=operation.watch,
    )
