"""Slow falls and rises of slowly wandering signals, and false alarms on the same plants while they are sound.

Rows come every 5 min. Each of one to nine outputs is a first-order autoregression of .985; where there are inputs,
which are held at random levels, it follows them with a lag besides. In every other record one output falls or rises by
9 to 14 standard deviations of what wanders, over 20 to 40 h, stays for a day, and returns. The bearing is one signal
over 80 days with four such falls.

    python -m benchmarks.promise --only slow [--seeds SETS] [--results FILE.jsonl]
"""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.stats import poisson

import reactorwatch as rw
from benchmarks.faults.detectors import Interval, incidents_of, intervals_of
from benchmarks.harness.study import Pool, head, line, percent, poisson_interval
from reactorwatch.arrays import Array
from reactorwatch.records.record import Record

SEED, RECORDS = 300, 40
PERIOD_MIN, PHI = 5.0, 0.985
TRAINING_ROWS, WATCHED_ROWS = 1000, 2400
STAY_ROWS, RETURN_ROWS = 288, 60
BEARING_TRAINING_ROWS, BEARING_ROWS, BEARINGS = 3400, 23_000, 4
"""Training of the bearing: 15 % of the record, as the Numenta benchmark has it."""


class Job(NamedTuple):
    """A record to watch."""

    seed: int
    number: int
    is_bearing: bool = False

    @property
    def inputs(self) -> int:
        """Number of inputs: of two records with a fall one has none."""
        return 0 if self.is_bearing else (0, 0, 1, 2)[self.number % 4]

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return 1 if self.is_bearing else (1, 2, 3, 5, 9)[self.number // 4 % 5]


class Fall(NamedTuple):
    """Fall or rise of an output.

    Attributes:
        start: first row of the fall.
        rows: number of rows to its full size.
        size: size in standard deviations of what wanders, positive for a rise.
    """

    start: int
    rows: int
    size: float

    @property
    def half(self) -> int:
        """Row of half its size."""
        return self.start + self.rows // 2

    @property
    def back(self) -> int:
        """Row in which the return begins."""
        return self.start + self.rows + STAY_ROWS

    def profile(self, rows: int) -> Array:
        """Size by row, shape (rows,)."""
        corners = [self.start, self.start + self.rows, self.back, self.back + RETURN_ROWS]
        return np.interp(np.arange(rows), corners, [0.0, self.size, self.size, 0.0])


class Result(NamedTuple):
    """Result of a record, as JSON keeps it."""

    inputs: int
    outputs: int
    sizes: list[float]  # size of each fall
    hours: list[float]  # duration of each
    seen_at: list[float]  # share of the duration after which an alarm is active; above 1: later
    standing: list[float]  # share of the rows from then, or from its end, to the return in which an alarm is active
    outside: list[str]  # first alarm of each incident that begins outside of falls and returns
    expected: float  # number of false alarms promised
    kept: bool  # false if the monitor says that the promise is not kept


def draw(job: Job) -> tuple[Record, list[Fall]]:
    """Draw a record."""
    rng = np.random.default_rng((job.seed, job.number, job.is_bearing))
    rows = BEARING_ROWS if job.is_bearing else TRAINING_ROWS + WATCHED_ROWS
    k, p = job.inputs, job.outputs
    steps = np.sqrt(1.0 - PHI**2) * rng.standard_normal((rows + 1000, p))
    outputs = lfilter([1.0], [1.0, -PHI], steps, axis=0)[1000:] + 0.1 * rng.standard_normal((rows, p))
    inputs = np.empty((rows, k))
    for column in range(k):
        holds = rng.integers(20, 80, rows)
        inputs[:, column] = np.repeat(rng.uniform(-1.0, 1.0, rows), holds)[:rows]
    lags, gains = rng.uniform(2.0, 40.0, k), rng.uniform(-3.0, 3.0, (k, p))
    for column, lag in enumerate(lags.tolist()):
        follows = lfilter([1.0 / lag], [1.0, 1.0 / lag - 1.0], inputs[:, column])
        outputs += follows[:, None] * gains[column]
    falls = []
    if job.is_bearing:
        starts = [6000 + 4300 * i + int(rng.integers(0, 1500)) for i in range(4)]
    else:
        starts = [TRAINING_ROWS + int(rng.integers(400, 1200))] if job.number % 2 else []
    for start in starts:
        size = float(rng.uniform(9.0, 14.0) * rng.choice([-1.0, 1.0]))
        falls.append(Fall(start, int(rng.uniform(20.0, 40.0) * 60.0 / PERIOD_MIN), size))
        outputs[:, 0] += falls[-1].profile(rows)
    names = [*(f"u{i + 1}" for i in range(k)), *(f"y{i + 1}" for i in range(p))]
    values = np.column_stack([50.0 + 5.0 * inputs, 80.0 + 4.0 * outputs])
    columns = {name: np.round(column, 2) for name, column in zip(names, values.T, strict=True)}
    return Record(PERIOD_MIN * np.arange(rows, dtype=np.float64), columns, f"slow {job.number}"), falls


def watch(job: Job) -> Result:
    """Draw a record, and watch it as a user does."""
    record, falls = draw(job)
    found = rw.backtest(
        record,
        inputs=tuple(f"u{i + 1}" for i in range(job.inputs)),
        outputs=tuple(f"y{i + 1}" for i in range(job.outputs)),
        training_rows=BEARING_TRAINING_ROWS if job.is_bearing else TRAINING_ROWS,
    )
    rows = np.arange(len(record.time_min))
    intervals = [Interval(*(time / PERIOD_MIN for time in item)) for item in intervals_of(found.alarm_messages)]
    active = np.zeros(rows.size, bool)
    for raised, cleared in intervals:
        active |= (rows >= raised) & (rows < cleared)
    seen_at, standing, excused = [], [], np.zeros(rows.size, bool)
    for fall in falls:
        later = np.flatnonzero(active[fall.start :])
        seen_at.append((int(later[0]) if later.size else rows.size) / fall.rows)
        since = min(fall.start + int(seen_at[-1] * fall.rows), fall.start + fall.rows)
        standing.append(float(active[since : fall.back].mean()))
        excused[fall.start : fall.back + RETURN_ROWS + 100] = True
    first = {item.message.incident: item for item in sorted(found.alarms, key=lambda item: -item.raised_min)}
    assert len(first) == incidents_of(found.alarm_messages)
    outside = [item.alarm for item in first.values() if not excused[round(item.raised_min / PERIOD_MIN)]]
    return Result(
        job.inputs,
        job.outputs,
        [fall.size for fall in falls],
        [fall.rows * PERIOD_MIN / 60.0 for fall in falls],
        seen_at,
        standing,
        outside,
        found.expected_false_alarms,
        (found.promise or {"kept": True})["kept"],
    )


def print_tables(pool: Pool, sets: int) -> None:
    """Watch the records, and print the tables."""
    slow = [Job(SEED + index, number) for index in range(sets) for number in range(RECORDS)]
    results = [Result(*item) for item in pool.run("slow changes", watch, slow)]
    columns = ("records", "seen", "before half way", "standing until the return", "incidents outside", "promised")
    print(head("slow changes", *columns, "probability of so many", "kept", "raised by"))
    for with_inputs in (False, True):
        group = [item for item in results if bool(item.inputs) == with_inputs]
        name = "with inputs" if with_inputs else "without inputs"
        _print_line(f"{name}, a fall or rise", [item for item in group if item.sizes])
        _print_line(f"{name}, sound", [item for item in group if not item.sizes])
    bearings = [Job(SEED + index, number, True) for index in range(sets) for number in range(BEARINGS)]
    _print_line("bearing, four falls each", [Result(*item) for item in pool.run("bearing", watch, bearings)])
    print(flush=True)


def _print_line(name: str, results: Sequence[Result]) -> None:
    seen_at = [share for item in results for share in item.seen_at]
    standing = [share for item in results for share in item.standing]
    came = Counter(alarm for item in results for alarm in item.outside)
    outside, expected = came.total(), sum(item.expected for item in results)
    low, high = poisson_interval(outside)
    cells = (
        f"{len(results)}",
        percent(sum(share < 1.0 for share in seen_at), len(seen_at)) if seen_at else "–",
        percent(sum(share < 0.5 for share in seen_at), len(seen_at)) if seen_at else "–",
        f"{np.mean(standing):.3f}, {sum(share == 1.0 for share in standing)} of {len(standing)} all of it"
        if standing
        else "–",
        f"{outside} ({low:.1f} to {high:.1f})",
        f"{expected:.2g}",
        f"{poisson.sf(outside - 1, expected):.2g}",
        f"{sum(item.kept for item in results)} of {len(results)}",
        ", ".join(f"{name} {number}" for name, number in came.most_common()) or "–",
    )
    print(line(name, *cells))
