"""Settings of a monitor that follow from the description of its process."""

from collections.abc import Mapping
from typing import Any

import msgspec

from monitor_node.config import MonitorConfig
from reactorwatch.description.process import Process, Signal
from reactorwatch.process.model import ProcessModel
from reactorwatch.units import conversion


def signal_settings(process: Process) -> dict[str, Any]:
    """Settings of the signals of a process: by key of `MonitorConfig`, as a flag of a command has them.

    With equations the inputs and outputs are theirs, in their order, and other ones are labels. Bounds and resolutions
    are in the units in which the signals are judged.
    """
    model = process.model
    inputs, outputs = (process.inputs, process.outputs) if model is None else (model.input_names, model.output_names)
    judged = {signal.name: signal for signal in process.signals if signal.name in (*inputs, *outputs)}
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
