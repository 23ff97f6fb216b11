"""Cost of a row of a plant with 52 signals and no equations, as all stages of a monitor take it.

Usage: python benchmarks/wide_rows.py [--rows 2000]
"""

import argparse
import time

import numpy as np

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Quality, Sample

SIGNALS, TRAINING = 52, 500
ROW_NS = 180 * 10**9
GOAL_US = 200.0


def simulate(rows: int, seed: int) -> Array:
    """Signals driven by eight slow factors, with noise, shape (rows, signals)."""
    rng = np.random.default_rng(seed)
    load, factor = rng.standard_normal((SIGNALS, 8)), np.zeros(8)
    values = np.empty((rows, SIGNALS))
    for row in values:
        factor = 0.9 * factor + rng.standard_normal(8)
        row[:] = load @ factor + 0.3 * rng.standard_normal(SIGNALS)
    return values


def measure(rows: int) -> float:
    """Processor time of a row from its samples to its verdict, in seconds: the least of five parts of the rows."""
    names = tuple(f"s{i}" for i in range(SIGNALS))
    config = MonitorConfig(process="", inputs=(), outputs=names, training_rows=TRAINING, smallest_sd={}, priorities={})
    monitor, good = Monitor(config, 0, points=False), Quality.QUALITY_GOOD
    samples = [
        [
            (name, Sample(time_ns=(k + 1) * ROW_NS, sequence=k, value=value, quality=good))
            for name, value in zip(names, row, strict=True)
        ]
        for k, row in enumerate(simulate(TRAINING + 10 + rows, 1).tolist())
    ]

    def process(first: int, end: int) -> float:
        start = time.process_time()
        for row in samples[first:end]:
            for name, sample in row:
                monitor.on_sample(name, sample, 0)
        return (time.process_time() - start) / (end - first)

    process(0, TRAINING + 10)
    part = rows // 5
    return min(process(TRAINING + 10 + i * part, TRAINING + 10 + (i + 1) * part) for i in range(5))


def main() -> None:
    """Print the cost beside the goal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=2000)
    cost_us = measure(parser.parse_args().rows) * 1e6
    text = f"{SIGNALS} signals, one row with its samples: {cost_us:.0f} us"
    print(f"{text}, {cost_us / GOAL_US:.2f} of the goal of {GOAL_US:g}")


if __name__ == "__main__":
    main()
