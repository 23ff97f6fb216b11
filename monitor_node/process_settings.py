"""Settings of a monitor that follow from the description of its process."""

from typing import Any

import msgspec

from monitor_node.config import MonitorConfig
from reactorwatch.description.process import Process
from reactorwatch.process.model import ProcessModel


def signal_settings(process: Process) -> dict[str, Any]:
    """Settings of the signals of a process: by key of `MonitorConfig`, as a flag of a command has them.

    With equations the signals are theirs, in their order.
    """
    model = process.model
    inputs, outputs = (process.inputs, process.outputs) if model is None else (model.input_names, model.output_names)
    return {"inputs": inputs, "outputs": outputs}


def order_inputs(config: MonitorConfig, model: ProcessModel | None) -> MonitorConfig:
    """Settings with the inputs in the order of the model's, if they are the same."""
    if model is None or set(config.inputs) != set(model.input_names):
        return config
    return msgspec.structs.replace(config, inputs=model.input_names)
