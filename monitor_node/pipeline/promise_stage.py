"""Promise of false alarms of one plant: it is stated after the training, alarms are counted, changes are published."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from msgspec.structs import replace

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.alarms.states import Event
from monitor_node.baseline.promise import PlantPromise, PromiseState, TrainingCheck
from monitor_node.baseline.training_rows import TrainingState
from monitor_node.config import MonitorConfig
from monitor_node.health.failures import Failures
from monitor_node.health.message import NODE
from monitor_node.pipeline.power import Watch, state_power
from monitor_node.signal_checks.stage import SignalChecks
from monitor_node.stages.chart_alarms import alarm_names
from monitor_node.stages.shift import NAME as SHIFT
from reactorwatch.arrays import Array
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, Promise
from reactorwatch.process.model import ProcessModel
from reactorwatch.spc import false_alarm_budget
from reactorwatch.spc.training_errors import QUANTILE

RAISED = Event.RAISED.value

LEAST_EXCESS = 1.5
"""Times as many false alarms as promised from which the promise is not kept."""

CheckTraining: TypeAlias = Callable[[MonitorConfig, ProcessModel | None, TrainingState, str], TrainingCheck]
"""Judges a training by itself, see `training_check`."""


class PromiseStage:
    """The promise of one plant.

    Args:
        config: settings of the monitor.
        board: alarms of the plant, whose texts warn of a promise that is not kept.
        failures: counter of errors, which leave the promise without what they concern.
        check: judges the training by itself; None: that is not done.
        states_power: True to state the deviations that would be seen.
        points: True to publish each promise; False: only one that is not kept or no longer holds.

    Attributes:
        promise: the promise; None before the end of the training.
        alarm_rates: false alarms a row by the errors that the training may have made, shape (draws,), after its end.
    """

    def __init__(
        self,
        config: MonitorConfig,
        board: Annunciator,
        failures: Failures,
        *,
        check: CheckTraining | None = None,
        states_power: bool = False,
        points: bool = True,
    ) -> None:
        self.states_power = states_power
        self._config, self._board, self._failures, self._check, self._points = config, board, failures, check, points
        self._watch: Watch | None = None
        self._published: Promise | None = None
        self._key = keys.key(config.plant, keys.PROMISE, NODE)
        charts = {name for name, _ in alarm_names(config)}
        self._names = {*charts, *config.charts, SHIFT, *SignalChecks.CHANCE_NAMES}
        self.alarm_rates = np.zeros(0)
        self.end()

    def end(self) -> None:
        """End the promise: no rows are evaluated."""
        self.promise: PlantPromise | None = None
        self._board.warning = ""

    @property
    def state(self) -> PromiseState | None:
        """State of the promise; None before the end of the training."""
        return None if self.promise is None else self.promise.state

    @property
    def power(self) -> bytes:
        """Deviations that would be seen, a serialized `Promise`; empty before the end of the training."""
        return b"" if self.promise is None else Promise(power=self.promise.power).SerializeToString()

    def restore(self, state: PromiseState | None, power: bytes) -> None:
        """Resume from `state` and `power`."""
        if state is not None:
            self.promise = PlantPromise(state, list(Promise.FromString(power).power))
            self._board.warning = self.promise.warning

    def start(self, rates: Array, mean_rate: float, period_min: float, excess: float, watch: Watch | None) -> None:
        """State the promise after a training; alarms so far go on to count.

        Args:
            rates: see `alarm_rates`.
            mean_rate: false alarms a row, on average over trainings.
            period_min: sampling period.
            excess: times as many false alarms as promised that residuals after moves of the inputs raise.
            watch: the plant as it is watched, to state its power by; None: that is not stated.
        """
        self.alarm_rates, self._watch = rates, watch
        rows = false_alarm_budget.DAYS_MIN / period_min
        mean, upper = rows * mean_rate, rows * float(np.quantile(rates, QUANTILE))
        before = PromiseState(0.0, 0.0, rows) if self.promise is None else self.promise.state
        state = replace(before, per_30_days=mean, upper_per_30_days=max(mean, upper), rows_in_30_days=rows)
        self.promise = PlantPromise(
            replace(state, check=TrainingCheck(excess=excess if excess > LEAST_EXCESS else 0.0))
        )
        self._board.warning = self.promise.warning

    def check(self, rows: TrainingState, model: ProcessModel | None, kind: str, rows_watched: int) -> str:
        """Judge the training by itself, and state the power; an error there leaves the promise without them.

        Args:
            rows: rows of the training.
            model: equations that judge; None: none do.
            kind: kind of the reference.
            rows_watched: number of rows evaluated since.

        Returns:
            A note if the promise is not kept, else empty.
        """
        if self.promise is None:
            return ""
        if self._watch is not None:
            watch, self._watch = self._watch, None
            try:
                self.promise.power = state_power(watch, rows)
            except Exception as error:  # noqa: BLE001 # the stage's border: alarms are right without it
                self._failures.add("power", error, "the deviations that would be seen are not stated")
        if self._check is not None:
            try:
                check = self._check(self._config, model, rows, kind)
            except Exception as error:  # noqa: BLE001 # the stage's border: alarms are right without it
                self._failures.add("promise", error, "the promise of false alarms is not checked by the training")
            else:
                check = replace(check, excess=max(check.excess, self.promise.state.check.excess))
                self.promise.state = replace(self.promise.state, check=check)
                self._board.warning = self.promise.warning
        return "" if self.promise.is_kept else self._note(rows_watched)

    def messages(self, time_ns: int, rows: int) -> list[Publication]:
        """The promise after a number of rows, if it is to be published and has changed."""
        promise = self.promise
        if promise is None or not (self._points or not promise.is_kept or promise.has_drifted(rows)):
            return []
        return self._publish(promise.message(time_ns, rows))

    def _publish(self, message: Promise) -> list[Publication]:
        if message == self._published:  # it was published for another reason in this row
            return []
        self._published = message
        return [Publication(self._key, message)]

    def count_alarms(self, time_ns: int, rows: int, publications: list[Publication], before: int) -> str:
        """Count the alarms that chance can raise among the publications of a row, from an index on.

        Returns:
            A note if the plant has drifted from its training by this row, else empty.
        """
        if self.promise is None:
            return ""
        alarms = [item.message for item in publications[before:] if isinstance(item.message, Alarm)]
        raised = [alarm for alarm in alarms if alarm.event == RAISED]
        count = sum(alarm.alarm.partition("/")[0] in self._names for alarm in raised)
        if not count:
            return ""
        had_drifted, has_drifted = self.promise.count_alarms(count, rows)
        if self._points or self._board.warning or has_drifted:
            publications.extend(self._publish(self.promise.message(time_ns, rows)))
        return self._note(rows) if has_drifted and not had_drifted else ""

    def _note(self, rows: int) -> str:
        assert self.promise is not None
        return f"promise: {self.promise.text(rows)}"
