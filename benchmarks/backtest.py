"""Speed of a back-test: rows a second of the monitor's core, beside a loop that only decodes the same samples.

Goal: at least 20,000 rows a second. The record is the plant's own, 50,000 rows with a leak in the last tenth of them.
The end of the training, its diagnosis and each look for a cause cost a fixed time, a tenth or two of a second each, so
a short record has fewer rows a second; their cost is printed. The first run of a process is not counted: it designs
the charts' limits and compiles the filters.

Last is a row of a black box with eight outputs, in processor time; asked are 60 microseconds.
"""

import time
from collections.abc import Callable, Iterable

import numpy as np

from benchmarks.harness.plants import messages_of
from benchmarks.harness.timing import fastest
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.identification.black_box_filter import BlackBoxFilter
from reactorwatch.identification.black_box_fit import fit_black_box

ROWS, SHORT = 50_000, 7500
REPEATS = 3
OUTPUTS, TRAINING, WATCHED = 8, 1000, 4000


def decode_all(messages: Iterable[Encoded]) -> int:
    """Decode every message; returns how many there were."""
    return sum(decode(message.payload, message.encoding) is not None for message in messages)


def black_box_row() -> float:
    """Microseconds of a row of a black box, the least of four parts."""
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
    return 1e6 * min(times)


def _seconds(run: Callable[[], object]) -> float:
    return fastest(run, REPEATS)[0]


def main() -> None:
    """Measure and print."""
    record = simulate_record(PlantConfig(seed=1, faults=("coolant_flow:step:-0.1@4500min",)), ROWS)
    messages = messages_of(record)
    sound = messages[: 3 * SHORT]
    result = backtest.run(messages, MonitorConfig())
    monitor_s = _seconds(lambda: backtest.run(messages, MonitorConfig()))
    blind = _seconds(lambda: backtest.run(messages, MonitorConfig(isolation=False)))
    given = _seconds(lambda: backtest.run(messages, MonitorConfig(diagnose_training=False)))
    short = _seconds(lambda: backtest.run(sound, MonitorConfig()))
    peer = _seconds(lambda: decode_all(messages))
    print(f"back-test            {ROWS / monitor_s:10,.0f} rows/s   ({len(result.raised_alarms)} alarms; goal: 20,000)")
    print(f"without isolation    {ROWS / blind:10,.0f} rows/s   (the looks cost {monitor_s - blind:.2f} s)")
    print(f"without diagnosis    {ROWS / given:10,.0f} rows/s   (that of the training costs {monitor_s - given:.2f} s)")
    print(f"{SHORT:,} sound rows     {SHORT / short:10,.0f} rows/s")
    print(f"decoding alone       {ROWS / peer:10,.0f} rows/s")
    print(f"ratio of the times   {monitor_s / peer:10.1f}")
    print(f"a row of a black box {black_box_row():10.0f} us")


if __name__ == "__main__":
    main()
