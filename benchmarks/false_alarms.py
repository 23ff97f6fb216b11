"""False alarms of the monitor beside the number promised: runs without a fault, with autocorrelated noise.

Both sensors' noise is an autoregression with the coefficient 0.5, and each run has a training of its own. Alarms come
nearly independently, so the standard error of their number is its square root.

    python benchmarks/false_alarms.py
"""

from collections import Counter
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import encode
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record
from recorder.tools.player import samples_of

RUNS, PER_30_DAYS = 80, 200.0
SPAN_MIN, PERIOD_MIN = 500.0, 0.1
NOISE_SD, COEFFICIENT, SETTLING_ROWS = (0.002, 0.3), 0.5, 100


class FalseAlarms(NamedTuple):
    """Alarms of several runs.

    Attributes:
        raised: number of alarms by name.
        promised: number of alarms that the monitor promised.
    """

    raised: Counter[str]
    promised: float

    @property
    def ratio(self) -> float:
        """Alarms raised, over those promised."""
        return self.raised.total() / self.promised


def count_false_alarms(runs: int, per_30_days: float, *, diagnose_training: bool = True) -> FalseAlarms:
    """Count the alarms of runs without a fault.

    Args:
        runs: number of runs of `SPAN_MIN`; the seeds count from 0.
        per_30_days: promised false alarms in 30 days.
        diagnose_training: see `MonitorConfig`; four fifths of the time of a run.
    """
    simulator, raised, promised = Simulator(cstr()), Counter[str](), 0.0
    config = MonitorConfig(false_alarms_per_30_days=per_30_days, isolation=False, diagnose_training=diagnose_training)
    rows = round(SPAN_MIN / PERIOD_MIN)
    time_min: Array = np.arange(rows, dtype=np.float64) * PERIOD_MIN
    for seed in range(runs):
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


def main() -> None:
    """Print what was raised and what was promised."""
    found = count_false_alarms(RUNS, PER_30_DAYS)
    print(f"{RUNS} runs of {SPAN_MIN:g} min, {PER_30_DAYS:g} false alarms in 30 days promised")
    print(f"alarms raised {found.raised.total()}, promised {found.promised:.1f}, ratio {found.ratio:.2f}")
    for name, count in found.raised.most_common():
        print(f"  {name:12s} {count}")


if __name__ == "__main__":
    main()
