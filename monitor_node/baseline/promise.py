"""Promise of false alarms of one plant: on average, for this plant, and as its training and the watch bear it out.

Limits aim at the configured rate always. On average over trainings they keep it. Of one plant an upper bound at 90 %
is stated, because its limits were estimated (`reactorwatch.spc.training_errors`). Both take the plant to go on as in
its training. Whether it does is checked twice: the second half of the training is judged by the first
(`training_check`), and the alarms that come while the plant is watched are compared with those promised.
"""

from collections.abc import Sequence
from math import log

import numpy as np
from msgspec.structs import replace
from scipy.special import pdtrc

from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Power, Promise
from reactorwatch.spc.false_alarm_budget import DAYS, DAYS_MIN
from reactorwatch.spc.training_errors import CONFIDENCE
from reactorwatch.stored_state import StoredState

UNLIKELY = 0.003
"""Probability of so many alarms by chance below which the promise is not kept."""

FEWEST_EVENTS = 3
"""Least number of separate events of a plant that is called drifted: one or two may be faults."""

SAME_EVENT_ROWS = 20
"""Rows within which alarms are of the same event."""

REMEDY = "train longer, or over more set points"


class TrainingCheck(StoredState, frozen=True):
    """The second half of a training, judged by the first.

    Attributes:
        rows: number of rows judged; 0: the training was too short.
        found: number of alarms, with limits for the promised rate.
        expected: number promised.
        excess: times as many false alarms as promised that the plant has by this check; 0: no more than promised.
    """

    rows: int = 0
    found: int = 0
    expected: float = 0.0
    excess: float = 0.0


class PromiseState(StoredState, frozen=True):
    """State of a plant's promise.

    Attributes:
        per_30_days: false alarms promised in 30 days, on average.
        upper_per_30_days: upper bound of that for this plant, at 90 %.
        rows_in_30_days: number of rows in 30 days.
        check: the training, judged by itself.
        found: number of alarms that chance can raise, since the training.
        events: number of separate events among them.
        last_row: row of the newest of them, counted from the training.
    """

    per_30_days: float
    upper_per_30_days: float
    rows_in_30_days: float
    check: TrainingCheck = TrainingCheck()
    found: int = 0
    events: int = 0
    last_row: int = 0

    @property
    def numbers(self) -> list[float]:
        """The state as numbers, `NUMBERS` of them."""
        check = self.check
        rates = (self.per_30_days, self.upper_per_30_days, self.rows_in_30_days)
        counts = (self.found, self.events, self.last_row)
        return [*rates, check.rows, check.found, check.expected, check.excess, *counts]

    @classmethod
    def from_numbers(cls, numbers: Sequence[float]) -> "PromiseState":
        """The state with these numbers."""
        per_30_days, upper, rows, checked, found, expected, excess, *counts = numbers
        check = TrainingCheck(int(checked), int(found), expected, excess)
        return cls(per_30_days, upper, rows, check, *(int(count) for count in counts))


NUMBERS = 10
"""Count of the numbers of a `PromiseState`."""


class PlantPromise:
    """Promise of one plant.

    Args:
        state: the state.
        power: deviations that would be seen.

    Attributes:
        state: the state.
        power: deviations that would be seen.
    """

    def __init__(self, state: PromiseState, power: Sequence[Power] = ()) -> None:
        self.state, self.power = state, power

    def count_alarms(self, count: int, row: int) -> tuple[bool, bool]:
        """Count alarms that chance can raise; returns whether the plant had drifted before, and has now.

        Args:
            count: number of alarms of a row.
            row: number of rows judged since the training.
        """
        state, had_drifted = self.state, self.has_drifted(row)
        is_new = not state.found or row - state.last_row > SAME_EVENT_ROWS
        self.state = replace(state, found=state.found + count, events=state.events + is_new, last_row=row)
        return had_drifted, self.has_drifted(row)

    def mean_count(self, rows: int) -> float:
        """False alarms promised in a number of rows, on average."""
        return self.state.per_30_days * rows / self.state.rows_in_30_days

    def upper_count(self, rows: int) -> float:
        """Upper bound at 90 % of the false alarms of this plant in a number of rows."""
        return self.state.upper_per_30_days * rows / self.state.rows_in_30_days

    def has_drifted(self, rows: int) -> bool:
        """True if more events raised alarms in a number of rows than chance explains, by all that is known."""
        events, upper = self.state.events, max(self.state.check.excess * self.mean_count(rows), self.upper_count(rows))
        return events >= FEWEST_EVENTS and float(pdtrc(events - 1, upper)) < UNLIKELY

    @property
    def is_kept(self) -> bool:
        """True if the training bears the promise out."""
        return not self.state.check.excess

    @property
    def can_keep_per_30_days(self) -> float:
        """False alarms in 30 days that can be promised: the configured rate, or what the training shows."""
        return self.state.per_30_days * max(self.state.check.excess, 1.0)

    @property
    def warning(self) -> str:
        """Words for the text of an alarm where the promise is not kept; empty where it is."""
        if self.is_kept:
            return ""
        return f"by its training, false alarms of this plant may come {describe_rate(self.can_keep_per_30_days)}"

    def text(self, rows: int) -> str:
        """One sentence for people, after a number of rows."""
        state, check = self.state, self.state.check
        if self.is_kept:
            parts = [
                f"false alarms in {DAYS} days: {state.per_30_days:.2g} on average, at most "
                f"{state.upper_per_30_days:.2g} for this plant with {100 * CONFIDENCE:.0f} % confidence"
            ]
            parts.append(
                f"in the second half of its training, judged by the first, {_count(check.found)}, "
                f"{check.expected:.2g} promised"
                if check.rows
                else "the training was too short to be judged by itself"
            )
        else:
            found = f"{_count(check.found)}, {check.expected:.2g} promised"
            parts = [
                (f"in the second half of its training, judged by the first, {found}: " if check.found else "")
                + "this plant wanders, its model errs after moves of the inputs, or its training has not seen enough of"
                f" it; from this training {describe_rate(self.can_keep_per_30_days)} can be promised; {REMEDY}"
            ]
        if state.found:
            parts.append(f"{_count(state.found)} since, {self.mean_count(rows):.2g} promised")
        if self.has_drifted(rows):
            parts.append("if nothing is wrong, the plant has drifted from its training: train it again")
        return "; ".join(parts)

    def message(self, time_ns: int, rows: int) -> Promise:
        """The message on the bus.

        Args:
            time_ns: time of the newest row.
            rows: number of rows judged since the training.
        """
        state = self.state
        return Promise(
            time_ns=time_ns,
            expected=state.per_30_days,
            expected_90=state.upper_per_30_days,
            checked_rows=state.check.rows,
            found_in_training=state.check.found,
            expected_in_training=state.check.expected,
            kept=self.is_kept,
            can_keep_per_30_days=self.can_keep_per_30_days,
            text=self.text(rows),
            rows=rows,
            found=state.found,
            expected_so_far=self.mean_count(rows),
            drifted=self.has_drifted(rows),
            power=self.power,
        )


def _count(alarms: int) -> str:
    return "1 alarm came" if alarms == 1 else f"{alarms or 'no'} alarms came"


def describe_rate(per_30_days: float) -> str:
    """A rate of alarms in words.

    >>> describe_rate(1080.0), describe_rate(40.0), describe_rate(2.0)
    ('1 in 40 min', '1 in 18 h', '1 in 15 days')
    """
    minutes = DAYS_MIN / per_30_days
    for unit, size in (("min", 1.0), ("h", 60.0)):
        if minutes < 100.0 * size:
            return f"1 in {minutes / size:.2g} {unit}"
    return f"1 in {minutes / 1440.0:.2g} days"


def probability_of(found: int, expected: Array) -> float:
    """Probability of at least so many alarms by chance.

    Args:
        found: number of alarms.
        expected: mean number for each of the errors that the training may have made.
    """
    return float(np.mean(pdtrc(found - 1, expected))) if found else 1.0


def extrapolate_count(found: int, arl0: float, opportunities: float, wanted_arl0: float) -> float:
    """False alarms in as many opportunities with other limits, from those with limits for one run length.

    Residuals larger than in the training by a factor have the logarithms of their run lengths divided by its square,
    because tails fall as exp(-L^2 / 2): a run length A that was intended becomes A^g, with g from the alarms found.

    >>> round(extrapolate_count(3, 1500.0, 4500.0, 1e6), 4)  # as many as intended
    0.0045

    Args:
        found: number of alarms, at least 1.
        arl0: run length for which the limits were.
        opportunities: rows times alarms.
        wanted_arl0: run length of the other limits.
    """
    exponent = min(max(log(opportunities / found), 0.0) / log(arl0), 1.0)
    return float(opportunities / wanted_arl0**exponent)
