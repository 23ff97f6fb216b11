"""Detectors on a run of the fault bank: the monitor, and the method of the report that this project starts from.

The report has fixed limits on the residuals of one linear model: a model of order 3 for each output is fitted to the
training, an ARX model by least squares (its residual is that of the next row) or an output-error model (that of its
free run). The mean and the standard deviation of the residuals of the training give the limits, mean +- 3 sigma, and
one point of C or of T beyond them is an alarm.

That is a false alarm every few minutes. So that it can be compared at an equal rate of false alarms, the limits are
widened, for both outputs alike, until long runs without a fault have the promised rate: counted, not computed from a
distribution, because the residuals are neither independent nor normal where a linear model meets a nonlinear plant.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness.bank import OUTPUTS, PERIOD_MIN, SIGNAL, TRAINING_MIN, TWINS
from benchmarks.harness.plants import messages_of
from benchmarks.study_figures.report_scheme import ORDER
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Alarm, Incident, Suspect
from reactorwatch.identification.linear import fit_linear
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.structure import Structure
from reactorwatch.records.record import Record, to_minutes

Statistic = NDArray[np.float32] | Array

TRAINING_ROWS = round(TRAINING_MIN / PERIOD_MIN)
LIKELY = 0.1
"""Suspects of at least this probability are among those that an operator would look at."""


class Interval(NamedTuple):
    """Interval in which an alarm was active; inf: it is still active."""

    raised_min: float
    cleared_min: float


class Outcome(NamedTuple):
    """Outcome of a detector in a run with a fault."""

    delay_min: float  # delay from the onset to the detection; inf: not detected
    false_alarms: int = 0  # number of alarms raised before the onset
    watched_min: float = 0.0  # watched time before the onset


def outcome_of(alarms: Sequence[Interval], watching_since_min: float, onset_min: float, until_min: float) -> Outcome:
    """Detection and false alarms of a run.

    The detection is the first alarm that is raised after the onset while no other stands: one that was standing
    already has no news for the operator.
    """
    detected_min, standing_until_min = inf, -inf
    for item in sorted(alarms, key=lambda item: item.raised_min):
        if onset_min <= item.raised_min <= until_min and item.raised_min >= standing_until_min:
            detected_min = item.raised_min
            break
        standing_until_min = max(standing_until_min, item.cleared_min)
    return Outcome(
        delay_min=detected_min - onset_min,
        false_alarms=sum(item.raised_min < onset_min for item in alarms),
        watched_min=max(onset_min - watching_since_min, 0.0),
    )


@dataclass(frozen=True)
class ReportMethod:
    """A chart of the residuals of one kind of model."""

    name: str  # name of the kind
    fit: Callable[[Structure, Array, Array], LinearModel]  # function of structure

    def statistic(self, record: Record) -> Array:
        """Larger residual of each row in standard deviations, shape (rows,).

        0 for the first rows, which cannot be predicted; infinite where the model's simulation has diverged.
        """
        worst = np.zeros(record.rows)
        flows = record.columns[SIGNAL]
        for signal in OUTPUTS:
            values = record.columns[signal]
            model = self.fit(Structure.of_order(ORDER), flows[:TRAINING_ROWS], values[:TRAINING_ROWS])
            residuals = model.residuals(flows, values)[:, 0]
            learned = residuals[:TRAINING_ROWS][np.isfinite(residuals[:TRAINING_ROWS])]
            off = np.abs(residuals - learned.mean()) / learned.std(ddof=1)
            worst = np.maximum(worst, np.where(np.isnan(off), 0.0, off))
        return worst


METHODS: tuple[ReportMethod, ...] = (
    ReportMethod("ARX", partial(fit_linear, "arx")),
    ReportMethod("OE", partial(fit_linear, "oe")),
)


def alarms_of(time_min: Array, statistic: Array, width: float) -> list[Interval]:
    """Intervals of the alarms of a run: each from a point that is out to the next that is in."""
    change = np.diff(statistic > width, prepend=False, append=False)
    edges = np.flatnonzero(change)
    times = np.append(time_min, inf)
    return [Interval(float(times[rise]), float(times[fall])) for rise, fall in edges.reshape(-1, 2)]


def count_alarms(statistics: Iterable[Statistic], width: float) -> int:
    """Count the alarms of some runs: points that are out, whose predecessor is in."""
    return sum(int(np.count_nonzero(np.diff(item > width, prepend=False, append=False))) // 2 for item in statistics)


def calibrated_width(statistics: Sequence[Statistic], rows_to_false_alarm: float) -> float:
    """The smallest width beyond which runs without a fault raise no more alarms than promised.

    A run raises an alarm for every rise from a row at or below the width to one above it. So the alarms at a width are
    as many as rows above it, less the pairs of neighbours that are both above it.
    """
    rows = np.concatenate(statistics)
    pairs = np.concatenate([np.minimum(item[1:], item[:-1]) for item in statistics])
    allowed = rows.size / rows_to_false_alarm
    levels = np.sort(rows[np.isfinite(rows)])[::-1]
    above = rows.size - np.searchsorted(np.sort(rows), levels, side="right")
    both_above = pairs.size - np.searchsorted(np.sort(pairs), levels, side="right")
    # From the widest limits inwards: where the count first passes what is allowed, the level before it is kept.
    too_many = above - both_above > allowed
    return float(levels[max(int(np.argmax(too_many)) - 1, 0)] if too_many.any() else levels[-1])


class Watched(NamedTuple):
    """Output of the monitor for a record."""

    messages: list[Alarm]  # every change of an alarm, in order
    incidents: list[Incident]  # every change of an incident, in order
    watching_since_min: float  # time of the first evaluated row; inf if there was none
    last_min: float  # time of the last row


class Suspicion(NamedTuple):
    """Ranks of the true cause among the suspects."""

    first: bool = False  # the true cause was the likeliest suspect
    likely: bool = False  # the true cause was among the suspects of at least `LIKELY`
    twin_first: bool = False  # a twin of it was the likeliest


def watch(record: Record, false_alarms_per_30_days: float) -> Watched:
    """Run the monitor over a record."""
    config = MonitorConfig(training_min=TRAINING_MIN, false_alarms_per_30_days=false_alarms_per_30_days)
    result = backtest.run(messages_of(record), config)
    since = result.watching_since_ns
    return Watched(
        messages=result.alarm_messages,
        incidents=result.incident_messages,
        watching_since_min=inf if since is None else to_minutes(since),
        last_min=to_minutes(result.last_ns),
    )


def intervals_of(messages: Iterable[Alarm]) -> list[Interval]:
    """Interval of each alarm, from the messages that it was raised and cleared."""
    raised: dict[str, float] = {}
    found = []
    for message in messages:
        if message.event == "raised":
            raised[message.alarm] = to_minutes(message.raised_ns)
        elif message.event == "cleared" and message.alarm in raised:
            found.append(Interval(raised.pop(message.alarm), to_minutes(message.cleared_ns)))
    return found + [Interval(minute, inf) for minute in raised.values()]


def incidents_of(messages: Iterable[Alarm]) -> int:
    """Number of incidents of the alarms."""
    return len({message.incident for message in messages if message.event == "raised"})


def newest_suspects(watched: Watched, incident: int, until_min: float = inf) -> list[Suspect]:
    """Suspects of an incident at a time in minutes, as an operator has them; empty without any."""
    own = [(item.time_ns, item.suspects) for item in watched.messages if item.names_cause and item.incident == incident]
    shared = [(item.time_ns, item.suspects) for item in watched.incidents if item.number == incident]
    found = [(at, suspects) for at, suspects in (*own, *shared) if suspects and to_minutes(at) <= until_min]
    return list(max(found, key=lambda item: item[0])[1]) if found else []


def suspicion(watched: Watched, cause: str, detected_min: float, until_min: float) -> Suspicion:
    """Suspicion of the monitor at a time.

    The newest suspects of the incident count, or those of an alarm of it that names its cause itself.
    """
    raised = (item for item in watched.messages if item.event == "raised")
    detecting = [item for item in raised if to_minutes(item.raised_ns) == detected_min]
    if not detecting:
        return Suspicion()
    newest = newest_suspects(watched, detecting[0].incident, until_min)
    if not newest:
        return Suspicion()
    suspects = sorted(newest, key=lambda item: -item.probability)
    return Suspicion(
        first=suspects[0].cause == cause,
        likely=any(item.cause == cause and item.probability >= LIKELY for item in suspects),
        twin_first=suspects[0].cause in TWINS.get(cause, frozenset()),
    )
