"""Promise of false alarms of one plant: on average, for this plant, and as its training and the watch bear it out.

Limits aim at the configured rate always: all alarms share it (`share_budget`). On average over trainings they keep it.
Of one plant an upper bound at 90 % is stated, because its limits were estimated
(`reactorwatch.spc.false_alarm_budget`). Both take the plant to go on as in its training. Whether it does is checked
twice: the second half of the training is judged by the first (`promise_check`), and the alarms that come while the
plant is watched are compared with those promised.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import msgspec
import numpy as np
from msgspec.structs import replace
from scipy.special import pdtrc

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.charts.chart_design import alarm_names
from monitor_node.charts.shift_and_drift import NAME as SHIFT
from monitor_node.checks.signal_checks import SignalChecks
from monitor_node.config import MonitorConfig
from monitor_node.health import NODE, Failures
from monitor_node.learn.baseline import TrainingResult
from monitor_node.learn.training_rows import TrainingRows
from monitor_node.watch.power import Watch, state_power
from reactorwatch.arrays import Array
from reactorwatch.contract import keys
from reactorwatch.contract.alarm_states import Event
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, Check, Promise
from reactorwatch.process.model import ProcessModel
from reactorwatch.sentences.promise import describe_broken_promise, describe_promise, describe_rate
from reactorwatch.spc import false_alarm_budget
from reactorwatch.spc.false_alarm_budget import QUANTILE
from reactorwatch.stored_state import Memory, Storable

EVENT_ROWS = 20
"""Rows after an alarm in which another one is of the same event: twice the memory of an average of the usual weight."""

UNLIKELY = 0.003
"""Probability of so many alarms by chance below which the promise is not kept."""


def share_budget(asked: float | None, chance_alarms: int, period_min: float, checks: list[Check]) -> float:
    """In-control run length of each alarm, in rows: the false alarms that are promised, shared by all alarms.

    Args:
        asked: false alarms in 30 days that the settings ask for; None: the default.
        chance_alarms: number of alarms that can be false alarms.
        period_min: time between rows.
        checks: gains a remark where another number than 1 is promised and none was asked for.

    Raises:
        InputError: the charts cannot keep the rate that the settings ask for.
    """
    promised = false_alarm_budget.promise_per_30_days(asked, chance_alarms, period_min)
    if asked is None and f"{promised:.3g}" != "1":
        rows, most = false_alarm_budget.DAYS_MIN / period_min, false_alarm_budget.USUAL_ROWS
        why = (
            f"{promised:.3g} false alarms in 30 days are promised instead of 1: that is the nearest that "
            f"the charts can keep for {chance_alarms} alarms and rows every {period_min:.3g} min"
            if promised > 1.0
            else f"1 false alarm in {most:,.0f} rows is promised, {describe_rate(promised)}: in 30 days there are only "
            f"{rows:.3g} rows; set false_alarms_per_30_days for another number"
        )
        checks.append(Check(name="promise", result=why))
    return false_alarm_budget.share_arl0(promised, chance_alarms, period_min)


class TrainingCheck(Storable, msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The second half of a training, judged by the first.

    Attributes:
        rows: number of rows judged; 0: the training was too short.
        found: number of alarms, with limits for the promised rate.
        expected: number promised.
        excess: times as many false alarms as promised that the plant has by this check; 0: no more than promised.
        excessive: charts that break the promise, and are left out for that.
    """

    rows: int = 0
    found: int = 0
    expected: float = 0.0
    excess: float = 0.0
    excessive: tuple[str, ...] = ()


class PlantPromise(Memory):
    """Promise of one plant. The object is its own memory.

    Attributes:
        per_30_days: false alarms promised in 30 days, on average.
        upper_per_30_days: upper bound of that for this plant, at 90 %.
        rows_in_30_days: number of rows in 30 days.
        check: the training, judged by itself.
        found: number of alarms that chance can raise, since the training.
        events: number of separate events among them.
        last_row: row of the newest of them, counted from the training.
        power: deviations that would be seen, a serialized `Promise`; empty: not stated.
    """

    per_30_days: float
    upper_per_30_days: float
    rows_in_30_days: float
    check: TrainingCheck = TrainingCheck()
    found: int = 0
    events: int = 0
    last_row: int = 0
    power: bytes = b""

    def count_alarms(self, count: int, row: int) -> tuple[bool, bool]:
        """Count alarms that chance can raise; returns whether the plant had drifted before, and has now."""
        had_drifted = self.has_drifted(row)
        self.events += not self.found or row - self.last_row > EVENT_ROWS
        self.found, self.last_row = self.found + count, row
        return had_drifted, self.has_drifted(row)

    def mean_count(self, rows: int) -> float:
        """False alarms promised in a number of rows, on average."""
        return self.per_30_days * rows / self.rows_in_30_days

    def has_drifted(self, rows: int) -> bool:
        """True if more events raised alarms in a number of rows than chance explains, by all that is known."""
        by_training = self.upper_per_30_days * rows / self.rows_in_30_days
        upper = max(self.check.excess * self.mean_count(rows), by_training)
        # one or two may be faults
        return self.events >= 3 and float(pdtrc(self.events - 1, upper)) < UNLIKELY

    @property
    def is_kept(self) -> bool:
        """True if the training bears the promise out."""
        return not self.check.excess

    @property
    def can_keep_per_30_days(self) -> float:
        """False alarms in 30 days that can be promised: the configured rate, or what the training shows."""
        return self.per_30_days * max(self.check.excess, 1.0)

    @property
    def warning(self) -> str:
        """Words for the text of an alarm where the promise is not kept; empty where it is."""
        return "" if self.is_kept else describe_broken_promise(self.can_keep_per_30_days, " of this plant")

    def text(self, rows: int) -> str:
        """One sentence for people, after a number of rows."""
        return self.message(0, rows).text

    def message(self, time_ns: int, rows: int) -> Promise:
        """The message on the bus, after a number of rows."""
        message = Promise(
            time_ns=time_ns,
            expected=self.per_30_days,
            expected_90=self.upper_per_30_days,
            checked_rows=self.check.rows,
            found_in_training=self.check.found,
            expected_in_training=self.check.expected,
            kept=self.is_kept,
            can_keep_per_30_days=self.can_keep_per_30_days,
            rows=rows,
            found=self.found,
            expected_so_far=self.mean_count(rows),
            drifted=self.has_drifted(rows),
            power=Promise.FromString(self.power).power,
        )
        message.text = describe_promise(message, self.rows_in_30_days)
        return message


def probability_of(found: int, expected: Array) -> float:
    """Probability of at least so many alarms by chance."""
    return float(np.mean(pdtrc(found - 1, expected))) if found else 1.0


def excess_by_events(events: Sequence[int], arl0: Sequence[float], opportunities: Sequence[float]) -> float:
    """Times as many false alarms as promised, by the events that came with limits for several run lengths.

    Residuals larger than in the training by a factor have the logarithms of their run lengths divided by its square,
    because tails fall as exp(-L^2 / 2): a run length A that was intended becomes A^g. The likeliest g for Poisson
    counts with all limits together holds for the first of them: with its own alone, one bad point of operation in a
    few hundred rows would stand for a rate.

    >>> round(excess_by_events([0, 3], [1e6, 1500.0], [4500.0, 4500.0]), 1)  # as many as intended
    1.0

    Args:
        events: number of separate events with each of the limits.
        arl0: run length for which these limits were.
        opportunities: rows without an active alarm, with each of the limits, times alarms.
    """
    g = np.linspace(0.02, 1.0, 99)
    expected = np.array(opportunities)[:, None] / np.array(arl0)[:, None] ** g
    fits = np.sum(np.array(events)[:, None] * np.log(expected) - expected, axis=0)
    return float(arl0[0] ** (1.0 - g[np.argmax(fits)]))


RAISED = Event.RAISED.value

CheckTraining: TypeAlias = Callable[[MonitorConfig, ProcessModel | None, TrainingRows, str], TrainingCheck]
"""Judges a training by itself, see `promise_check`."""


class PromiseStage:
    """The promise of one plant.

    Attributes:
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
        self._published: Promise | None = None
        self._key = keys.key(config.plant, keys.PROMISE, NODE)
        charts = {name for name, _ in alarm_names(config)}
        self._names = {*charts, *config.charts, SHIFT, *SignalChecks.CHANCE_NAMES}
        self.alarm_rates = np.zeros(0)
        self.promise = None

    @property
    def promise(self) -> PlantPromise | None:
        """The promise; None before the end of the training. The texts of alarms warn of one that is not kept."""
        return self._promise

    @promise.setter
    def promise(self, promise: PlantPromise | None) -> None:
        self._promise = promise
        self._board.warning = "" if promise is None else promise.warning

    def start(self, rates: Array, mean_rate: float, period_min: float, excess: float) -> None:
        """State the promise after a training; alarms so far go on to count."""
        self.alarm_rates = rates
        rows = false_alarm_budget.DAYS_MIN / period_min
        mean, upper = rows * mean_rate, rows * float(np.quantile(rates, QUANTILE))
        check = TrainingCheck(excess=excess if excess > 1.5 else 0.0)
        before = self.promise
        counts = (0, 0, 0) if before is None else (before.found, before.events, before.last_row)
        self.promise = PlantPromise(mean, max(mean, upper), rows, check, *counts)

    def check(self, trained: TrainingResult, model: ProcessModel | None) -> TrainingCheck:
        """Judge the training by itself; an error there leaves the promise without it."""
        if self.promise is None or self._check is None:
            return TrainingCheck()
        try:
            return self._check(self._config, model, trained.rows, trained.reference.kind)
        except Exception as error:  # noqa: BLE001 # the stage's border: alarms are right without it
            self._failures.add("promise", error, "the promise of false alarms is not checked by the training")
            return TrainingCheck()

    def conclude(self, check: TrainingCheck, watch: Watch | None, rows: TrainingRows, rows_watched: int) -> str:
        """Take over a check, and state the power; an error there leaves the promise without it.

        Returns:
            A note if the promise is not kept, else empty.
        """
        if self.promise is None:
            return ""
        self.promise.check = replace(check, excess=max(check.excess, self.promise.check.excess))
        self._board.warning = self.promise.warning
        if watch is not None:
            try:
                self.promise.power = Promise(power=state_power(watch, rows)).SerializeToString()
            except Exception as error:  # noqa: BLE001 # the stage's border: alarms are right without it
                self._failures.add("power", error, "the deviations that would be seen are not stated")
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

    def count_alarms(self, time_ns: int, rows: int, alarms: list[Alarm], publications: list[Publication]) -> str:
        """Count the alarms of a row that chance can raise.

        Returns:
            A note if the plant has drifted from its training by this row, else empty.
        """
        if self.promise is None:
            return ""
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
