"""Cost of the charts a row, and effect of autocorrelation on their false alarms.

Cost: those of one signal; and all charts of one plant as the monitor runs them, of two outputs. Goal: 20 microseconds.
False alarms: mean run length of charts designed for independent data on AR(1) data of unit variance, by simulation,
beside the run length computed for independent data.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.charts.charts import ChartWatch
from monitor_node.config import ChartName, MonitorConfig
from monitor_node.ingest.rows import Interval, MeasuredRow
from reactorwatch.spc.charts.base import SignalSetting
from reactorwatch.spc.charts.catalogue import CHARTS
from reactorwatch.spc.charts.cusum import Cusum, cusum_run_length
from reactorwatch.spc.charts.ewma import Ewma, ewma_run_length
from reactorwatch.spc.charts.shewhart import Shewhart, shewhart_run_length
from reactorwatch.spc.compiled_chart import OUT, CompiledChart, SignalMemory, X, columns_of
from reactorwatch.spc.prewhitening import Prewhitening

ROWS, REPEATS, RUNS = 20_000, 5, 4_000
PHIS = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9)


def all_charts() -> list[CompiledChart]:
    """One of each kind."""
    return [Shewhart(0.0, 1.0, rules=(1, 2, 3, 4)), Cusum(0.0, 1.0), Ewma(0.0, 1.0, exact_limits=True)]


def best_of(run: Callable[[], object]) -> float:
    """Seconds of the fastest of some repeats, after one that is not counted."""
    run()
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def update_all(update: Callable[[Any], object], samples: Sequence[Any]) -> None:
    """Feed samples one by one."""
    for x in samples:
        update(x)


def costs() -> None:
    """Print the cost of a row."""
    rng = np.random.default_rng(1)
    values = rng.standard_normal(ROWS).tolist()
    total = 0.0
    print(f"{'cost a row':<12}{'single':>12}")
    for chart in all_charts():
        single = best_of(partial(update_all, chart.update, values)) / ROWS
        total += single
        print(f"{chart.name:<12}{single * 1e6:9.2f} us")
    print(f"{'all':<12}{total * 1e6:9.2f} us   (goal: 20)")


def of_a_plant() -> None:
    """Print what all charts of a plant cost a row in the monitor."""
    rng = np.random.default_rng(2)
    learned = [Prewhitening(0.0, (0.1,), 1.0, 1000, 5e-4, 1e-3)] * 2
    residuals = rng.standard_normal((ROWS, 2)).tolist()
    interval = Interval(True, False, 0)
    rows = [MeasuredRow(time_ns, (0.0,), e, ["", ""], interval, True, []) for time_ns, e in enumerate(residuals)]
    kinds: tuple[tuple[ChartName, ...], ...] = (
        MonitorConfig().charts,
        tuple(
            kind.name
            for kind in CHARTS
            if kind.name != "parameters" and not any(isinstance(item, SignalSetting) for item in kind.settings)
        ),
    )
    for charts in kinds:
        config = MonitorConfig(charts=charts)
        watch = ChartWatch(config, Annunciator(config))
        e = rng.standard_normal((1000, 2))
        values = np.column_stack([rng.standard_normal(1000), e])
        watch.design.choose([True, True], e, values)
        watch.start(learned, e, values, 2e6)

        def run(watch: ChartWatch = watch) -> None:
            for row in rows:
                watch.update(row, row.values, (False, False), [1.0, 1.0], points=False)

        each = best_of(run) / ROWS
        print(f"{', '.join(charts)}: {each * 1e6:.2f} us a row of one plant   (goal: 20)")


def simulated_run_length(chart: CompiledChart, phi: float, seed: int) -> tuple[float, float]:
    """Mean run length on AR(1) data of unit variance, and its standard error."""
    rng = np.random.default_rng(seed)
    columns = columns_of(type(chart), SignalMemory(chart.name, np.tile(chart.memory.numbers, RUNS)))
    x = rng.standard_normal(RUNS)
    running, lengths = np.ones(RUNS, dtype=np.bool_), np.zeros(RUNS)
    while running.any():
        lengths += running
        columns[X] = x
        chart.kernel(columns)
        running &= columns[OUT] <= 0.0
        x = phi * x + np.sqrt(1.0 - phi * phi) * rng.standard_normal(RUNS)
    return float(lengths.mean()), float(lengths.std() / np.sqrt(RUNS))


def autocorrelation() -> None:
    """Print the run lengths without a shift, by the autocorrelation."""
    charts: list[tuple[str, CompiledChart, float]] = [
        ("Shewhart 3 sigma", Shewhart(0.0, 1.0), shewhart_run_length(0.0)),
        ("CUSUM h 4", Cusum(0.0, 1.0, h=4.0), cusum_run_length(0.0, h=4.0)),
        ("CUSUM h 5", Cusum(0.0, 1.0, h=5.0), cusum_run_length(0.0, h=5.0)),
        ("EWMA 0.1, L 2.814", Ewma(0.0, 1.0, 0.1, 2.814), ewma_run_length(0.0, 0.1, 2.814)),
    ]
    print("\n| phi | " + " | ".join(name for name, _, _ in charts) + " |\n" + "|---" * (len(charts) + 1) + "|")
    print("| 0, computed | " + " | ".join(f"{length:.0f}" for _, _, length in charts) + " |")
    for phi in PHIS:
        found = [simulated_run_length(chart, phi, seed=1) for _, chart, _ in charts]
        print(f"| {phi:g} | " + " | ".join(f"{mean:.0f} ± {error:.0f}" for mean, error in found) + " |")


def main() -> None:
    """Measure and print."""
    costs()
    of_a_plant()
    autocorrelation()


if __name__ == "__main__":
    main()
