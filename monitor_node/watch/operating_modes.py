"""Modes of operation of a plant: each has a baseline of its own.

The modes that the training has seen, with rows enough, are judged by what was learned in them. A mode in which the
plant starts up or shuts down, or one that the training has not seen, is watched by the signal checks only.
"""

from collections.abc import Mapping

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.learn.arx_reference import ArxReference
from monitor_node.watch.evaluation import Evaluation
from monitor_node.watch.kept_baselines import KeptBaselines
from monitor_node.watch.pipeline_state import ModesState, ModeTraining
from monitor_node.watch.training_stage import TrainingStage
from reactorwatch.stored_state import copy_of


class OperatingModes:
    """Present mode of a plant, and the baselines of the others.

    Args:
        config: settings of the monitor.
        models: identified models.
        training: training of the plant.
        evaluation: evaluation of its rows.
        baselines: baselines of the plant.

    Attributes:
        state: the full state.
    """

    def __init__(
        self,
        config: MonitorConfig,
        models: ArxReference,
        training: TrainingStage,
        evaluation: Evaluation,
        baselines: KeptBaselines,
    ) -> None:
        self._names, self._startup = config.modes, config.startup_modes
        self._models, self._training, self._evaluation, self._baselines = models, training, evaluation, baselines
        self.state = ModesState([float("nan")] * len(config.modes))

    def copy_state(self) -> ModesState:
        """A copy of the state."""
        return msgspec.structs.replace(
            self.state, baselines=dict(self.state.baselines), trainings=dict(self.state.trainings)
        )

    def restore(self, state: ModesState) -> None:
        """Resume from a copy of a state."""
        self.state = state
        self.state = self.copy_state()

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
        return sum(item.rows.dropped + len(item.rows.times) for item in self.state.trainings.values())

    def change(self, values: Mapping[str, float]) -> str:
        """Leave the present mode, and judge by what was learned in the next, or go on to learn it.

        Args:
            values: newest values of the modes.

        Returns:
            A note if the mode is new and its rows are not judged, else empty.
        """
        state, training, evaluation = self.state, self._training, self._evaluation
        evaluation.leave_ordinary()
        old, began_ns = key_of(state.mode), training.began_ns
        if state.is_judged and evaluation.reference is not None:
            state.baselines[old] = self._baselines.make(evaluation.reference)
        elif state.is_judged and training.rows.times:
            state.trainings[old] = ModeTraining(training.rows, copy_of(self._models.memory))
        evaluation.incident = None
        state.mode, state.expected = [values[name] for name in self._names], self.expected_false_alarms
        new = key_of(state.mode)
        self._baselines.stop_judging()
        state.is_judged = not self.is_startup(state.mode)
        if not state.is_judged:
            return ""
        if (known := state.baselines.pop(new, None)) is not None:
            self._baselines.restore(known)
            state.expected = 2.0 * state.expected - self.expected_false_alarms
            return ""
        begun = state.trainings.pop(new, None)
        state.is_resumed = begun is not None and state.is_learned
        training.restart(began_ns)
        if begun is not None:
            training.rows = copy_of(begun.rows)
            self._models.resume(begun.models)
            self._models.restart()
        if not state.is_learned or (begun and training.is_enough()):
            return ""
        state.is_judged = False
        return (
            f"{self.describe()} was not seen in the training: its rows are watched by signal checks only; "
            "`baseline relearn` learns them"
        )

    @property
    def expected_false_alarms(self) -> float:
        """Mean number of false alarms expected so far, in all modes."""
        return self.state.expected + self._evaluation.expected_false_alarms

    def describe(self) -> str:
        """The present mode, as texts have it."""
        return ", ".join(f"{name} {value:.6g}" for name, value in zip(self._names, self.state.mode, strict=True))


def key_of(mode: list[float]) -> str:
    """Key of a mode in the state."""
    return ",".join(map(repr, mode))
