"""Checks of a record before a monitor learns from it."""

import numpy as np

from monitor_node.baseline.arx_fit import arx_structure, fewest_rows
from monitor_node.baseline.training import FEWEST_ROWS
from monitor_node.config import MonitorConfig
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record


def check_training_record(record: Record, config: MonitorConfig, model: ProcessModel | None) -> dict[str, str]:
    """Check that a monitor can learn from a record.

    Args:
        record: the record, with the signals of the settings.
        config: settings of the monitor.
        model: equations; None: models are identified.

    Returns:
        Inputs that never move, with the reason why they explain nothing.

    Raises:
        InputError: there are too few rows, or no output ever changes.
    """
    constant = {name: value for name in config.signals if (value := _only_value(record, name)) is not None}
    still = [name for name in config.outputs if name in constant and not config.smallest_sd.get(name)]
    if len(still) == len(config.outputs):
        readings = ", ".join(f"{name} reads {constant[name]:g}" for name in still)
        raise InputError(
            f"{record.name}: at least one output must change, got {readings} in all {record.rows} rows; "
            "name outputs that do, or a record in which they do"
        )
    structure = arx_structure(config)
    needed = FEWEST_ROWS if model is not None else fewest_rows(structure)
    if record.rows <= needed:
        of_what = "the noise of the sensors" if model is not None else f"{structure.parameters} parameters an output"
        raise InputError(
            f"{record.name}: must have more than {needed} rows to learn {of_what} from, got {record.rows}; "
            "record for longer, or learn from another record (--train)"
        )
    return {
        name: f"it never moves: it reads {constant[name]:g} in all rows" for name in config.inputs if name in constant
    }


def _only_value(record: Record, name: str) -> float | None:
    """Value that a signal has in all rows; None if it varies."""
    values = record.columns.get(name)
    if values is None or not np.isfinite(values).any():
        return None
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return low if low == high else None
