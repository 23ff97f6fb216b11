"""Costs of watching: rows a second of a back-test, memory of a plant in its normal state, a row of a black box.

    python -m benchmarks.promise.costs

Times are of the processor, so that others on the machine count little.
"""

import logging
import time

import numpy as np
import structlog

from benchmarks.backtest import decode_all
from benchmarks.scale import FAST, Counting
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import encode
from reactorwatch.identification.black_box.filter import BlackBoxFilter
from reactorwatch.identification.black_box.fit import fit_black_box
from reactorwatch.runtime.event_loop import StopSignal
from recorder.tools.player import samples_of

ROWS, PLANTS = 20_000, 1000
OUTPUTS, TRAINING, WATCHED = 8, 1000, 4000


def main() -> None:
    """Measure and print."""
    print("| cost | measured | asked |\n|---|---|---|")
    rows_per_s, ratio = backtest_rows()
    print(f"| back-test with equations, {ROWS:,} rows | {rows_per_s:,.0f} rows/s, {ratio:.1f} x decoding | 21,300 |")
    print(f"| memory of a plant in its normal state, with equations | {plant_kB():.1f} kB | 12 kB |")
    each_us, memory_kB = black_box_row()
    print(f"| a row of a black box with {OUTPUTS} outputs | {each_us:.0f} us | 60 us |")
    print(f"| numbers of its filter | {memory_kB:.0f} kB | - |", flush=True)


def backtest_rows() -> tuple[float, float]:
    """Rows a second of a back-test, and its time over that of decoding the same samples."""
    messages = [encode(item) for item in samples_of(simulate_record(PlantConfig(seed=1), ROWS), "cstr")]
    backtest.run(messages[:4500], MonitorConfig())  # compiles
    start = time.process_time()
    backtest.run(messages, MonitorConfig())
    spent_s, start = time.process_time() - start, time.process_time()
    decode_all(messages)
    return ROWS / spent_s, spent_s / (time.process_time() - start)


def plant_kB() -> float:  # noqa: N802 # kB is the unit
    """Memory of a plant in its normal state, by that of a fleet."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    return Counting(FAST, StopSignal()).learn(PLANTS) / 1000.0


def black_box_row() -> tuple[float, float]:
    """Microseconds of a row of a black box, the least of four parts, and kilobytes of its numbers."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.normal(size=((TRAINING + WATCHED) // 10, 1)), 10, axis=0)
    map_, states = (
        np.diag(np.linspace(0.3, 0.9, OUTPUTS)) + 0.05 * rng.normal(size=(OUTPUTS, OUTPUTS)),
        np.zeros(OUTPUTS),
    )
    y = np.empty((len(u), OUTPUTS))
    for k, value in enumerate(u):
        y[k] = states + 0.1 * rng.normal(size=OUTPUTS)
        states = map_ @ states + value
    follows = np.arange(TRAINING) > 0
    model = fit_black_box(u[:TRAINING], y[:TRAINING], follows, np.full(OUTPUTS, 1e-3))
    watching, limits = BlackBoxFilter(model), [6.0] * OUTPUTS
    watching.run(u[:TRAINING], y[:TRAINING], follows)
    times, inputs, measured = [], u[TRAINING:].tolist(), y[TRAINING:].tolist()
    for part in range(4):
        start = time.process_time()
        for k in range(part * WATCHED // 4, (part + 1) * WATCHED // 4):
            watching.update(inputs[k], measured[k], limits)
        times.append(4.0 * (time.process_time() - start) / WATCHED)
    return 1e6 * min(times), watching.belief.nbytes / 1000.0


if __name__ == "__main__":
    main()
