"""Process that a monitor watches: its signals and equations in the settings of the monitor."""

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
from monitor_node.process_settings import signal_settings
from reactorwatch.description.find import find_process
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.process.model import ProcessModel


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
    changed: dict[str, object] = {"units": process.units} | _restrict(described, described | named)
    for signal in (name for names in named.values() for name in names):
        if signal not in (*process.inputs, *process.outputs):
            raise InputError(describe_unknown("signal", signal, (*process.inputs, *process.outputs)))
    if process.model is None:
        changed["process"] = WITHOUT_EQUATIONS
    if process.name != DEFAULT.name:
        if config.smallest_sd == DEFAULT.watch.smallest_sd:
            changed["smallest_sd"] = dict(process.watch.smallest_sd)
        if config.priorities == DEFAULT_PRIORITIES:
            changed["priorities"] = dict(process.watch.priorities)
        if not _states_training(config):
            minutes = process.watch.training_min
            changed |= {"training_rows": DEFAULT_TRAINING_ROWS} if minutes is None else {"training_min": minutes}
    changed_config = msgspec.structs.replace(config, **changed)
    return WatchedProcess(limit_training(changed_config, rows, is_stated=_states_training(config)), process.model)


def _restrict(described: dict[str, Any], chosen: dict[str, Any]) -> dict[str, Any]:
    """Settings of the signals of a process, for the inputs and outputs that are watched."""
    inputs, outputs = chosen["inputs"], chosen["outputs"]
    others = [name for key in ("inputs", "outputs") for name in described[key] if name not in (*inputs, *outputs)]
    return {
        "inputs": inputs,
        "outputs": outputs,
        "setpoints": described["setpoints"],
        "modes": described["modes"],
        "labels": (*described["labels"], *others),
        "bounds": {name: bounds for name, bounds in described["bounds"].items() if name in (*inputs, *outputs)},
        "resolution": {name: step for name, step in described["resolution"].items() if name in outputs},
    }


def limit_training(config: MonitorConfig, rows: int | None, *, is_stated: bool | None = None) -> MonitorConfig:
    """Limit a training that is not stated to a third of a record; that of the reactor stays as it is.

    Args:
        config: settings of a monitor.
        rows: number of rows of the record; None: unknown.
        is_stated: True if the length is stated; None: as the settings say.
    """
    stated = _states_training(config) if is_stated is None else is_stated
    length = config.training_length
    if stated or rows is None or length.minutes is not None:
        return config
    return msgspec.structs.replace(config, training_rows=max(1, min(length.rows, rows // 3)))


def _states_training(config: MonitorConfig) -> bool:
    return config.training_min is not None or config.training_rows is not None
