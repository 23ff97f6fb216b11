"""Time of a look for causes, and of a row without one, for any value that a sensor shows.

Runs of bad values, of 1 to 50 rows, within the range of a signal and far out of it, in a sound plant whose monitor
looks for causes. Beside it, in the same run, the peer: looks at faults of the catalogue, which are what the budget of
filter steps is made for. So are looks at rows that are farther apart, and the first look of the process, after what a
monitor prepares at its start. All are given in seconds of this process and as a ratio; steps are the same on every
machine.

Goal: a look within 0.25 s and a row within 50 ms, for any value, any distance of rows, and the first look too.

    python benchmarks/looks.py [runs of bad values]
"""

import random
import sys
import time
from collections.abc import Iterable, Sequence
from statistics import median
from typing import NamedTuple

from benchmarks.harness.plants import draw_bad_value
from monitor_node.alarms.alarms import SuspectedCause
from monitor_node.causes.isolation import LOOK_STEPS, LOOK_STEPS_A_ROW, Isolation
from monitor_node.causes.stage import FEW_ROWS, LOOKS, ROWS_BEFORE, preparation
from monitor_node.causes.window import Row
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.watched_process import signal_ranges
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import encode
from reactorwatch.contract.messages_pb2 import Sample
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.library.cstr import cstr
from recorder.tools.player import samples_of

RUNS = 300
CONFIG = MonitorConfig(training_min=20.0)
SIGNALS = CONFIG.signals
TRAINED, ROWS = 240, 350
FAULTS = ("coolant_flow:step:-0.05", "coolant_flow:step:-0.3", "heat_transfer:step:-0.8", "temperature_bias:step:30")
PERIODS_MIN = (0.2, 0.5, 1.0, 5.0, 25.0)
LOOK_S, ROW_S = 0.25, 0.05


class Look(NamedTuple):
    """Seconds of the process, filter steps, and whether it stopped at its budget."""

    seconds: float
    steps: int
    stopped: bool


class TimedIsolation:
    """Notes every look while it is in use."""

    def __init__(self) -> None:
        self.looks: list[Look] = []
        self._suspects = Isolation.suspects

    def __enter__(self) -> "TimedIsolation":
        looks, original = self.looks, self._suspects

        def suspects(self: Isolation, rows: Sequence[Row], since_rows: int = 0) -> list[SuspectedCause]:
            began = time.process_time()
            found = original(self, rows, since_rows)
            looks.append(Look(time.process_time() - began, self.budget.spent, self.stopped))
            return found

        Isolation.suspects = suspects  # type: ignore[method-assign]
        return self

    def __exit__(self, *_: object) -> None:
        Isolation.suspects = self._suspects  # type: ignore[method-assign]


def look_at_faults(period_min: float = 0.1, looks: Sequence[int] = LOOKS) -> None:
    """Look at faults of the catalogue some rows after their onset, without the progress of an earlier look."""
    for fault in FAULTS:
        onset_min = 600 * period_min
        record = simulate_record(
            PlantConfig(seed=4, period_min=period_min, faults=(f"{fault}@{onset_min}min",)), 601 + looks[-1]
        )
        columns = (record.time_min, record.columns["qc"], record.columns["C"], record.columns["T"])
        rows = [(t, (u,), (c, T)) for t, u, c, T in zip(*(column.tolist() for column in columns), strict=True)]
        for after in looks:
            isolation = Isolation(cstr(), NoiseLevels((0.002, 0.3), (0.0, 0.0)))
            isolation.suspects(rows[600 - max(600 - after, ROWS_BEFORE) : 600 + after], since_rows=min(after, FEW_ROWS))


def watch_bad_values(runs: int, looks: list[Look], seed: int = 1) -> list[float]:
    """Let a monitor watch runs of bad values; returns the seconds of the slowest row without a look, of each run."""
    draw, record = random.Random(seed), simulate_record(PlantConfig(seed=9), ROWS)
    published = samples_of(record, CONFIG.plant, 0)
    samples = [(item.key.rsplit("/", 1)[1], Sample.FromString(encode(item).payload)) for item in published]
    trained = Monitor(CONFIG, 0)
    _feed(trained, samples[: 3 * TRAINED], looks)
    state, slowest = trained.to_bytes(), []
    for _ in range(runs):
        bad = _bad_values(draw)
        monitor = Monitor(CONFIG, 0)
        monitor.from_bytes(state)
        monitor.on_history_end()
        changed = []
        for at, (signal, sample) in enumerate(samples[3 * TRAINED :]):
            other = Sample()
            other.CopyFrom(sample)
            other.value = bad.get((signal, at // 3), sample.value)
            changed.append((signal, other))
        slowest.append(max(_feed(monitor, changed, looks)))
        assert monitor.failures.by_stage == {}, monitor.failures.notes
    return slowest


def _bad_values(draw: random.Random) -> dict[tuple[str, int], float]:
    """Values by signal and row of one or two runs: within the range of the signal, at its edges, or anywhere."""
    bad: dict[tuple[str, int], float] = {}
    for _ in range(draw.choice((1, 1, 2))):
        place = draw.randrange(len(SIGNALS))
        lower, upper, _ = signal_ranges(cstr(), SIGNALS)[place]
        value = draw_bad_value(draw, lower, upper)
        first, rows = draw.randrange(20), draw.randrange(1, 51)
        bad |= {(SIGNALS[place], row): value() for row in range(first, first + rows)}
    return bad


def _feed(monitor: Monitor, samples: Iterable[tuple[str, Sample]], looks: list[Look]) -> list[float]:
    """Feed samples; returns the seconds of those that brought no look."""
    seconds = []
    for signal, sample in samples:
        before, began = len(looks), time.process_time()
        monitor.on_sample(signal, sample, 0)
        if len(looks) == before:
            seconds.append(time.process_time() - began)
    return seconds


def main(runs: int) -> bool:
    """Measure and print; returns whether the goals are met."""
    began = time.process_time()
    parts = sum(1 for _ in preparation(CONFIG, cstr()))
    print(f"prepared by a monitor when it has started: {time.process_time() - began:.3f} s in {parts} parts")
    with TimedIsolation() as timed:
        look_at_faults()
        first, peer = timed.looks[:1], timed.looks[1:]
        timed.looks.clear()
        for period_min in PERIODS_MIN:
            look_at_faults(period_min, [since for since in LOOKS if since <= FEW_ROWS])
        sparse = timed.looks.copy()
        timed.looks.clear()
        rows = watch_bad_values(runs, timed.looks)
        looks = timed.looks
    budget, usual = LOOK_STEPS + LOOK_STEPS_A_ROW * CONFIG.isolation_rows, median(item.seconds for item in peer)
    kinds = {"first look": first, "faults of the catalogue (peer)": peer, "rows far apart": sparse, "bad values": looks}
    for name, found in kinds.items():
        worst = max(item.seconds for item in found)
        print(
            f"{name:31s} {len(found):4d} looks: median {median(item.seconds for item in found):.3f} s, "
            f"longest {worst:.3f} s ({worst / usual:.1f} times the peer's median); "
            f"most steps {max(item.steps for item in found):,} of {budget:,}; "
            f"{sum(item.stopped for item in found)} stopped at the budget"
        )
    longest, row = max(item.seconds for found in kinds.values() for item in found), max(rows)
    print(f"longest row without a look      {1e3 * row:.1f} ms ({row / usual:.2f} times the peer's median look)")
    is_met = longest <= LOOK_S and row <= ROW_S
    goals = f"a look within {LOOK_S} s, a row within {1e3 * ROW_S:.0f} ms"
    print(f"goal: {goals}: {'met' if is_met else 'NOT met'}")
    return is_met


if __name__ == "__main__":
    sys.exit(0 if main(int(sys.argv[1]) if len(sys.argv) > 1 else RUNS) else 1)
