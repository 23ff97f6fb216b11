"""Process that a monitor watches: its signals, their possible ranges, and its equations, in the monitor's settings.

A value beyond the bounds of a state or an input, such as 9999 of a broken wire or -999 of a converter, is no
measurement. Filters, charts and the search for causes do not use it. Near a bound of the model a sensor may read a
little beyond it, so the model's bounds are widened.
"""

from collections.abc import Mapping
from dataclasses import replace
from math import inf, isfinite
from typing import Any, NamedTuple

import msgspec

from monitor_node.config import (
    DEFAULT,
    DEFAULT_PRIORITIES,
    DEFAULT_SIGNALS,
    DEFAULT_TRAINING_ROWS,
    WITHOUT_EQUATIONS,
    MonitorConfig,
)
from reactorwatch.description.process import Process, Signal
from reactorwatch.description.read import find_process
from reactorwatch.diagnosis.parameter_priors import check_priors
from reactorwatch.errors import InputError, describe_unknown, prefix_errors
from reactorwatch.process.model import ProcessModel, Variable
from reactorwatch.units import conversion


class WatchedProcess(NamedTuple):
    """Settings of a monitor and the equations that judge.

    Attributes:
        config: settings with the signals of the process.
        model: equations, with minutes from 1970-01-01 UTC; None: those of the reactor where its signals are watched.
    """

    config: MonitorConfig
    model: ProcessModel | None


def load_process(config: MonitorConfig, zero_ns: int = 0, rows: int | None = None) -> WatchedProcess:
    """Load the process that the settings name.

    Args:
        config: settings of a monitor.
        zero_ns: zero of the minutes of an extended model, if its file does not have it.
        rows: number of rows of the record; None: unknown, as of a live plant.

    Raises:
        InputError: the process cannot be found or read, or does not fit the settings.
    """
    if not config.process:
        return WatchedProcess(limit_training(config, rows), None)
    return watch_process(config, find_process(config.process, zero_ns, on_bus=True), rows)


def watch_process(config: MonitorConfig, process: Process, rows: int | None = None) -> WatchedProcess:
    """Settings for a process: its signals, where the settings have the default ones, and its equations.

    Bounds and resolutions that the settings state go before those of the process.

    Args:
        config: settings of a monitor.
        process: the process, its clock that of the bus.
        rows: see `load_process`.

    Raises:
        InputError: the settings name other signals, or ask for equations that the process does not have.
    """
    if config.reference == "equations":
        process.require_model()
    described = signal_settings(process)
    named = {key: getattr(config, key) for key, names in DEFAULT_SIGNALS.items() if getattr(config, key) != names}
    stated = {key: getattr(config, key) for key in ("bounds", "resolution")}
    for signal in (name for names in (*named.values(), *stated.values()) for name in names):
        if signal not in (*process.inputs, *process.outputs):
            raise InputError(describe_unknown("signal", signal, (*process.inputs, *process.outputs)))
    changed = {"units": process.units} | described | named
    names = (*changed["inputs"], *changed["outputs"])
    unwatched = (name for key in DEFAULT_SIGNALS for name in described[key] if name not in names)
    changed["labels"] = (*described["labels"], *unwatched)
    for key, watched in (("bounds", names), ("resolution", changed["outputs"])):
        values = described[key] | stated[key]
        changed[key] = {name: value for name, value in values.items() if name in watched}
    if config.uncertain:
        with prefix_errors("settings [monitor]"):
            check_priors(process.require_model(), config.uncertain)
    changed["uncertain"] = process.uncertain | config.uncertain
    if process.model is None:
        changed["process"] = WITHOUT_EQUATIONS
    if process.watch != DEFAULT.watch:
        if config.smallest_sd == DEFAULT.watch.smallest_sd:
            changed["smallest_sd"] = dict(process.watch.smallest_sd)
        if config.priorities == DEFAULT_PRIORITIES:
            changed["priorities"] = dict(process.watch.priorities)
        if not _states_training(config):
            minutes = process.watch.training_min
            changed |= {"training_rows": DEFAULT_TRAINING_ROWS} if minutes is None else {"training_min": minutes}
    try:
        changed_config = msgspec.structs.replace(config, **changed)
    except ValueError as error:  # what could not be checked without the signals
        raise InputError(f"settings [monitor]: {error}") from error
    model = process.model
    if model is not None and process.generic:  # its alarms are traced to all causes with which it is diagnosed
        model = replace(model, effects=process.causes)
    return WatchedProcess(limit_training(changed_config, rows, is_stated=_states_training(config)), model)


def signal_settings(process: Process) -> dict[str, Any]:
    """Settings of the signals of a process: by key of `MonitorConfig`, as a flag of a command has them.

    With equations the inputs and outputs are theirs, in their order, and other ones are labels. Bounds and resolutions
    are in the units in which the signals are judged.
    """
    model = process.model
    inputs, outputs = (process.inputs, process.outputs) if model is None else (model.input_names, model.output_names)
    names = {*inputs, *outputs}
    judged = {signal.name: signal for signal in process.signals if signal.name in names}
    bounds, resolution = {}, {}
    for name, signal in judged.items():
        scale, offset = _to_judged_unit(signal, {} if model is None else model.units)
        if signal.bounds is not None:
            bounds[name] = tuple(sorted(scale * value + offset for value in signal.bounds))
        if signal.resolution is not None and name in outputs:
            resolution[name] = abs(scale) * signal.resolution
    others = [name for name in (*process.inputs, *process.outputs) if name not in judged]
    return {
        "inputs": inputs,
        "outputs": outputs,
        "setpoints": process.names("setpoint"),
        "modes": process.names("mode"),
        "labels": (*process.names("label"), *others),
        "bounds": bounds,
        "resolution": resolution,
    }


def _to_judged_unit(signal: Signal, model_units: Mapping[str, str]) -> tuple[float, float]:
    """Scale and offset from a signal's unit to that of the equations."""
    wanted = model_units.get(signal.name, signal.unit)
    if not signal.unit or signal.unit == wanted:
        return 1.0, 0.0
    return conversion(signal.unit, wanted, f"signal {signal.name!r}")


def order_inputs(config: MonitorConfig, model: ProcessModel | None) -> MonitorConfig:
    """Settings with the inputs in the order of the model's, if they are the same."""
    if model is None or set(config.inputs) != set(model.input_names):
        return config
    return msgspec.structs.replace(config, inputs=model.input_names)


def judging_equations(config: MonitorConfig, model: ProcessModel | None) -> ProcessModel | None:
    """Equations by which a plant is judged, as the settings ask for it; None: by none.

    Raises:
        InputError: the settings ask for equations that do not fit the signals.
    """
    if config.reference in ("black-box", "arx") or (model is None and config.process == WITHOUT_EQUATIONS):
        return None
    given, model = model is not None, model or DEFAULT.require_model()
    if config.inputs == model.input_names and set(config.outputs) <= set(model.output_names):
        return model
    if config.reference == "auto" and not given:
        return None
    raise InputError(
        f"reference 'equations' needs the signals of {model.name}, inputs {', '.join(model.input_names)} and outputs "
        f"of {', '.join(model.output_names)}, got {', '.join(config.inputs) or 'none'} and "
        f'{", ".join(config.outputs)}; set reference = "arx"'
    )


def limit_training(config: MonitorConfig, rows: int | None, *, is_stated: bool | None = None) -> MonitorConfig:
    """Limit a training that is not stated to a third of a record; that of the reactor stays as it is."""
    stated = _states_training(config) if is_stated is None else is_stated
    length = config.training_length
    if stated or rows is None or length.minutes is not None:
        return config
    return msgspec.structs.replace(config, training_rows=max(1, min(length.rows, rows // 3)))


def _states_training(config: MonitorConfig) -> bool:
    return config.training_min is not None or config.training_rows is not None


class SignalRange(NamedTuple):
    """Possible values of a signal.

    Attributes:
        lower: smallest value.
        upper: largest value.
        unit: unit of both.
    """

    lower: float = -inf
    upper: float = inf
    unit: str = ""

    @property
    def is_bounded(self) -> bool:
        """True if the range is limited."""
        return self.lower > -inf or self.upper < inf


ANY = SignalRange()
"""Range of a signal without known bounds."""


def signal_ranges(model: ProcessModel | None, signals: tuple[str, ...]) -> list[SignalRange]:
    """Range of each signal."""
    if model is None:
        return [ANY] * len(signals)
    states = {state.name: state for state in model.states}
    variables = {variable.name: variable for variable in model.inputs}
    for output in model.outputs:
        if output.expression.is_symbolic() and output.expression.name() in states:
            variables[output.name] = states[output.expression.name()]
    return [_widen(variables[signal]) if signal in variables else ANY for signal in signals]


def stated_ranges(config: MonitorConfig) -> list[SignalRange]:
    """Range of each signal of a row as the settings state it, without a margin."""
    ranges = []
    for signal in config.signals:
        lower, upper = config.bounds.get(signal, (-inf, inf))
        # a value at a bound may be beyond it after a conversion of units
        rounding = 1e-9 * (upper - lower) if isfinite(upper - lower) else 0.0
        ranges.append(SignalRange(lower - rounding, upper + rounding, config.units.get(signal, "")))
    return ranges


def possible_ranges(config: MonitorConfig, model: ProcessModel | None) -> list[SignalRange]:
    """Range of each signal of a row: as stated, and within that of the model."""
    pairs = zip(stated_ranges(config), signal_ranges(model, config.signals), strict=True)
    return [
        SignalRange(max(stated.lower, given.lower), min(stated.upper, given.upper), given.unit or stated.unit)
        for stated, given in pairs
    ]


def input_bounds(config: MonitorConfig, model: ProcessModel | None) -> list[SignalRange]:
    """Bounds at which each input is saturated: as stated, else those of the model."""
    variables = {} if model is None else {variable.name: variable for variable in model.inputs}
    bounds = []
    for name in config.inputs:
        variable = variables.get(name)
        unit = config.units.get(name, "") if variable is None else variable.unit
        if name in config.bounds:
            bounds.append(SignalRange(*config.bounds[name], unit))
        else:
            bounds.append(ANY if variable is None else SignalRange(variable.lower, variable.upper, unit))
    return bounds


def _widen(variable: Variable) -> SignalRange:
    span = variable.upper - variable.lower
    # for noise and bias of a sensor
    margin = 0.05 * span if isfinite(span) else 0.0
    return SignalRange(variable.lower - margin, variable.upper + margin, variable.unit)
