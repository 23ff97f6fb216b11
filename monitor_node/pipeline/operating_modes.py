"""Modes of operation of a plant: each has a baseline of its own.

The modes that the training has seen, with rows enough, are judged by what was learned in them. A mode in which the
plant starts up or shuts down, or one that the training has not seen, is watched by the signal checks only.
"""

from collections.abc import Mapping

from monitor_node.config import MonitorConfig
from monitor_node.pipeline.pipeline_state import ModesState


class OperatingModes:
    """Present mode of a plant, and the baselines of the others.

    Args:
        config: settings of the monitor.

    Attributes:
        state: the full state.
    """

    def __init__(self, config: MonitorConfig) -> None:
        self._names, self._startup = config.modes, config.startup_modes
        self.state = ModesState([float("nan")] * len(config.modes))

    def is_change(self, values: Mapping[str, float]) -> bool:
        """Take over the newest values of the modes; returns True if the plant has changed its mode.

        A first value is no change: rows before it are of the same mode.
        """
        new, old = [values[name] for name in self._names], self.state.mode
        if new == old:
            return False
        is_first = all(before != before or before == value for before, value in zip(old, new, strict=True))
        if is_first and not self.is_startup(new):
            self.state.mode = new
            return False
        return True

    def is_startup(self, mode: list[float]) -> bool:
        """True if the plant starts up or shuts down in a mode."""
        return any(value in self._startup.get(name, ()) for name, value in zip(self._names, mode, strict=True))

    @property
    def rows(self) -> int:
        """Rows of the trainings of other modes."""
        return sum(len(item.rows.times_ns) // 8 for item in self.state.trainings.values())

    def describe(self) -> str:
        """The present mode, as texts have it."""
        return ", ".join(f"{name} {value:.6g}" for name, value in zip(self._names, self.state.mode, strict=True))


def key_of(mode: list[float]) -> str:
    """Key of a mode in the state."""
    return ",".join(map(repr, mode))
