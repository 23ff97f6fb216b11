"""False alarms of the monitor beside the number promised: runs without a fault, with autocorrelated noise.

Both sensors' noise is an autoregression with the coefficient 0.5, and each run has a training of its own. Alarms come
nearly independently, so the standard error of their number is its square root.

    python -m benchmarks.false_alarms
"""

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from benchmarks.promise.pool import poisson_interval, run_jobs
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import encode
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record
from reactorwatch.runtime.parallel import choose_executor
from reactorwatch.runtime.parallel.jobs import Executor
from recorder.tools.player import samples_of

RUNS, PER_30_DAYS = 80, 200.0
SPAN_MIN, PERIOD_MIN = 500.0, 0.1
NOISE_SD, COEFFICIENT, SETTLING_ROWS = (0.002, 0.3), 0.5, 100


class FalseAlarms(NamedTuple):
    """Alarms of several runs."""

    raised: Counter[str]  # number of alarms by name
    promised: float  # number of alarms that the monitor promised

    @property
    def ratio(self) -> float:
        """Alarms raised, over those promised."""
        return self.raised.total() / self.promised


def count_false_alarms(seeds: Iterable[int], per_30_days: float, *, diagnose_training: bool = True) -> FalseAlarms:
    """Count the alarms of runs without a fault."""
    simulator, raised, promised = Simulator(cstr()), Counter[str](), 0.0
    config = MonitorConfig(false_alarms_per_30_days=per_30_days, isolation=False, diagnose_training=diagnose_training)
    rows = round(SPAN_MIN / PERIOD_MIN)
    time_min: Array = np.arange(rows, dtype=np.float64) * PERIOD_MIN
    for seed in seeds:
        random = np.random.default_rng(seed)
        qc = np.repeat(random.uniform(90, 111, rows // 10), 10)
        outputs = simulator.run(time_min, qc, np.array([0.1, 438.54])).outputs
        white = random.normal(size=(rows + SETTLING_ROWS, 2)) * np.sqrt(1 - COEFFICIENT**2) * NOISE_SD
        outputs = outputs + lfilter([1.0], [1.0, -COEFFICIENT], white, axis=0)[SETTLING_ROWS:]
        record = Record(time_min, {"qc": qc, "C": outputs[:, 0], "T": outputs[:, 1]}, "sound", units=cstr().units)
        result = backtest.run(map(encode, samples_of(record, "cstr")), config)
        raised.update(alarm.alarm for alarm, _ in result.raised_alarms)
        promised += result.expected_false_alarms
    return FalseAlarms(raised, promised)


def watch(seed: int) -> FalseAlarms:
    """Count the alarms of one run."""
    return count_false_alarms([seed], PER_30_DAYS)


def print_table(executor: Executor, runs: int = RUNS) -> None:
    """Print what was raised and what was promised in a number of runs."""
    found = list(run_jobs(executor, watch, range(runs)))
    raised, promised = sum((item.raised for item in found), Counter[str]()), sum(item.promised for item in found)
    low, high = poisson_interval(raised.total())
    print(f"{runs} runs of {SPAN_MIN:g} min, noise with AR {COEFFICIENT:g}, {PER_30_DAYS:g} false alarms in 30 days:")
    names = ", ".join(f"{name} {count}" for name, count in raised.most_common())
    ratio = f"{raised.total() / promised:.2f} (95 %: {low / promised:.2f} to {high / promised:.2f})"
    print(f"alarms raised {raised.total()}, promised {promised:.1f}, ratio {ratio}; {names}", flush=True)


if __name__ == "__main__":
    print_table(choose_executor())
