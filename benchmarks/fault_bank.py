"""Detection delay and false alarms of the monitor, beside the report's method and an oracle.

Every fault of the bank (`benchmarks/harness/bank.py`) in three sizes and for many seeds: 100 minutes of training, 200
without a fault, then the fault for 150. All detectors watch the same records at the same promised rate of false alarms:

- the oracle, which knows the fault (`benchmarks/faults/oracle.py`): no detector can be much faster;
- the monitor, as it is configured by default;
- the report's method (`benchmarks/faults/detectors.py`), with limits widened to that rate, and at its own 3 sigma.

Then runs without a fault, with white and with autocorrelated noise: the realised rate of false alarms.

    python benchmarks/fault_bank.py [--quick] [--write FILE] [--budgets 1 30] [--results FILE] [--jobs N]

Goals: the median delay at most half that of the report's method at an equal rate of false alarms; that rate kept.
"""

import argparse
import time
from functools import partial
from pathlib import Path

from rich.console import Console

from benchmarks.faults.detectors import METHODS, calibrated_width
from benchmarks.faults.study import (
    Widths,
    fault_free_statistics,
    rows_to_false_alarm,
    run_case,
    run_fault_free,
)
from benchmarks.faults.tables import print_fault_free, print_summary, print_table
from benchmarks.harness.bank import PERIOD_MIN, cases
from benchmarks.harness.pool import Pool, add_options
from benchmarks.harness.tables import stamp

SEEDS, FAULT_FREE_RUNS, CALIBRATION_RUNS = 20, 200, 400
QUICK_SEEDS, QUICK_FAULT_FREE_RUNS, QUICK_CALIBRATION_RUNS = 2, 6, 60
FAULT_FREE_ROWS = round(750 / PERIOD_MIN)
CALIBRATION_ROWS = 20_000
CALIBRATION_SEED, FAULT_FREE_SEED = 500_000, 700_000
PHIS = (0.0, 0.5)

HEAD = """# The watch on a bank of faults

Sixteen faults in three sizes, with twenty runs each, are watched by the monitor with its default settings, by an oracle
that knows the fault, and by the method of the original report: 3 sigma on ARX and on OE residuals, with its own limits
and with limits widened to the same rate of false alarms. `make faults` writes this page; [watching.md](watching.md)
explains it.
"""


def main() -> None:
    """Run the benchmark and print it."""
    parser = argparse.ArgumentParser(description="The monitor against a bank of faults.")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_SEEDS} seeds, for a try")
    parser.add_argument("--write", type=Path, help="where the tables are written too, as a page (.md)")
    parser.add_argument(
        "--budgets", type=float, nargs="+", default=[1.0, 30.0], help="false alarms in 30 days that are promised"
    )
    add_options(parser)
    chosen = parser.parse_args()
    seeds, quiet_runs, calibration_runs = (
        (QUICK_SEEDS, QUICK_FAULT_FREE_RUNS, QUICK_CALIBRATION_RUNS)
        if chosen.quick
        else (SEEDS, FAULT_FREE_RUNS, CALIBRATION_RUNS)
    )
    budgets, pool, began = tuple(chosen.budgets), Pool.of(chosen), time.perf_counter()
    statistics = pool.run(
        "limits of the report's method",
        partial(fault_free_statistics, rows=CALIBRATION_ROWS),
        [CALIBRATION_SEED + number for number in range(calibration_runs)],
    )
    widths: Widths = {
        method.name: {
            budget: calibrated_width([item[method.name] for item in statistics], rows_to_false_alarm(budget))
            for budget in budgets
        }
        for method in METHODS
    }
    found = pool.run("faults", partial(run_case, budgets=budgets, widths=widths), cases(seeds))
    quiet = pool.run(
        "fault-free runs",
        partial(run_fault_free, rows=FAULT_FREE_ROWS, budgets=budgets, widths=widths),
        [(FAULT_FREE_SEED + number, phi) for phi in PHIS for number in range(quiet_runs)],
    )
    console = Console(width=200, record=chosen.write is not None)
    for budget in budgets:
        print_table(console, found, budget)
        print_summary(console, found, budget, widths)
        print_fault_free(console, quiet, budget)
    console.print(f"\n{len(found)} runs with a fault, {len(quiet)} without, {time.perf_counter() - began:.0f} s")
    if chosen.write is not None:
        chosen.write.write_text(f"{HEAD}\n{stamp()}\n\n```\n{console.export_text()}```\n")


if __name__ == "__main__":
    main()
