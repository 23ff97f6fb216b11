"""`make faults`: detection delay and false alarms of the monitor, beside the report's method and an oracle.

Every fault of the bank (`benchmarks/harness/bank.py`) in three sizes and for many seeds: 100 minutes of training, 200
without a fault, then the fault for 150. All detectors watch the same records at the same promised rate of false alarms:

- the oracle, which knows the fault (`benchmarks/faults/study.py`): no detector can be much faster;
- the monitor, as it is configured by default;
- the report's method (`benchmarks/faults/detectors.py`), with limits widened to that rate, and at its own 3 sigma.

Then runs without a fault, with white and with autocorrelated noise: the realised rate of false alarms.

    python -m benchmarks.faults [--quick] [--write FILE] [--budgets 1 30] [--results FILE] [--jobs N]

Goals: the median delay at most half that of the report's method at an equal rate of false alarms; that rate kept.
"""

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from math import exp, isfinite
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.faults.detectors import LIKELY, METHODS, Suspicion, calibrated_width
from benchmarks.faults.study import (
    DAYS_30_MIN,
    MONITOR,
    ORACLE,
    SOON_MIN,
    CaseResult,
    FaultFreeResult,
    Rate,
    Widths,
    detectors,
    fault_free_statistics,
    rows_to_false_alarm,
    run_case,
    run_fault_free,
    total,
)
from benchmarks.harness.bank import AFTER_MIN, BANK, GRADES, PERIOD_MIN, cases
from benchmarks.harness.study import Pool, add_options, stamp


def quantiles(delays_min: Sequence[float]) -> tuple[float, float]:
    """Median and 90 % quantile of delays; those not detected count as infinite."""
    median, slow = np.quantile(np.array(delays_min), [0.5, 0.9], method="inverted_cdf")
    return float(median), float(slow)


def delays(results: Sequence[CaseResult], budget: float, detector: str) -> list[float]:
    """Delays of a detector in some cases."""
    return [item.outcomes[budget][detector].delay_min for item in results]


def before_onset(results: Sequence[CaseResult], budget: float, detector: str) -> Rate:
    """False alarms of a detector before the faults set in."""
    outcomes = [item.outcomes[budget][detector] for item in results]
    return Rate(sum(item.false_alarms for item in outcomes), sum(item.watched_min for item in outcomes))


def print_table(console: Console, results: Sequence[CaseResult], budget: float) -> None:
    """The table by fault and size."""
    table = Table(title=f"At {_promise(budget)}: detected, median / 90 % delay in minutes", title_justify="left")
    table.add_column("fault")
    table.add_column("size")
    for detector in detectors():
        table.add_column(detector, justify="right")
    for heading in ("ceiling", "first", "likely", "twin", "out"):
        table.add_column(heading, justify="right")
    for fault in BANK:
        for grade in GRADES:
            found = [item for item in results if item.case.fault == fault and item.case.grade == grade]
            if found:
                _add_row(table, fault.name, f"{abs(found[0].case.size):g}", found, budget)
        table.add_section()
    for grade in GRADES:
        found = [item for item in results if item.case.grade == grade]
        if found:
            _add_row(table, "all", grade, found, budget)
    _add_row(table, "all", "all", list(results), budget)
    console.print(table)
    console.print(
        f"first, likely, twin: runs at whose end the monitor's first suspect was the true cause, the true cause was "
        f"among its suspects of at least {LIKELY:g}, its first suspect was a twin of the true cause. ceiling: the true "
        "cause was first for an oracle that knows the onset. out: runs that the fault put out. Not detected in "
        f"{AFTER_MIN:g} min counts as endless (–)."
    )


def print_summary(console: Console, results: Sequence[CaseResult], budget: float, widths: Widths) -> None:
    """The lines that answer what was asked of the faults."""
    console.rule(f"[bold]{_promise(budget)}", align="left")
    groups = [(grade, [item for item in results if item.case.grade == grade]) for grade in GRADES]
    for name, found in [*groups, ("all", list(results))]:
        if not found:
            continue
        console.print(f"{name:<7}{len(found):>5} runs")
        for detector in detectors():
            console.print(f"    {detector:<15}{_cell(delays(found, budget, detector)):>24}", end="")
            if detector not in (ORACLE, MONITOR):
                ratio, both = _ratio(found, budget, detector), _both(found, budget, detector)
                console.print(f"   monitor's median over its: {ratio}; where both detect: {both}", end="")
            console.print()
        for when, suspicions in (
            (f"{SOON_MIN:g} min after the alarm", [item.soon[budget] for item in found]),
            ("at the end of the run", [item.late[budget] for item in found]),
        ):
            console.print(f"    suspect {when}: {_suspects(suspicions, found, budget)}")
        console.print(f"    the oracle's suspect at the end of the run: first {_ceiling(found)} of all runs")
    console.print("false alarms before the onset, in 30 days (95 % interval):")
    for detector in detectors()[1:]:
        rate = before_onset(results, budget, detector)
        chance = 1 - exp(-rate.per_30_days * AFTER_MIN / DAYS_30_MIN)
        console.print(
            f"    {detector:<15}{_rate(rate)}; by chance alone {chance:.1%} of the runs would count as detected"
        )
    said = ", ".join(f"{method.name} +- {widths[method.name][budget]:.2f} sigma" for method in METHODS)
    console.print(f"limits of the report's method at equal rate: {said}")


def print_fault_free(console: Console, results: Sequence[FaultFreeResult], budget: float) -> None:
    """The realised rates of false alarms."""
    console.print(f"fault-free runs at {_promise(budget)}: realised in 30 days (95 % interval)")
    for phi in sorted({item.phi for item in results}):
        found = [item for item in results if item.phi == phi]
        console.print(f"  {'white noise' if phi == 0 else f'AR(1) noise, phi {phi:g}'}, {len(found)} runs")
        for detector in found[0].alarms[budget]:
            console.print(f"    {detector:<15}{_rate(total([item.alarms[budget][detector] for item in found]))}")
        console.print(f"    {'incidents':<15}{_rate(total([item.incidents[budget] for item in found]))}  (monitor)")
        names = Counter(name for item in found for name in item.names[budget])
        runs = sum(bool(item.names[budget]) for item in found)
        said = ", ".join(f"{name} {count}" for name, count in names.most_common())
        console.print(f"    the monitor's alarms came in {runs} runs: {said or 'none'}")


def _add_row(table: Table, name: str, size: str, found: Sequence[CaseResult], budget: float) -> None:
    late = [item.late[budget] for item in found]
    table.add_row(
        name,
        size,
        *(_cell(delays(found, budget, detector)) for detector in detectors()),
        _ceiling(found),
        _share([item.first for item in late]),
        _share([item.likely for item in late]),
        _share([item.twin_first for item in late]),
        str(sum(item.left_branch for item in found) or ""),
    )


def _promise(budget: float) -> str:
    return f"{budget:g} false alarm{'' if budget == 1 else 's'} in 30 days"


def _cell(delays_min: Sequence[float]) -> str:
    median, slow = quantiles(delays_min)
    return f"{sum(map(isfinite, delays_min)) / len(delays_min):.0%} {_minutes(median)} / {_minutes(slow)}"


def _minutes(value: float) -> str:
    if not isfinite(value):
        return "–"
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"


def _share(values: Sequence[bool]) -> str:
    return f"{sum(values) / len(values):.0%}"


def _both(found: Sequence[CaseResult], budget: float, detector: str) -> str:
    """Medians over the runs in which both detect."""
    both = zip(delays(found, budget, MONITOR), delays(found, budget, detector), strict=True)
    pairs = [pair for pair in both if all(map(isfinite, pair))]
    if not pairs:
        return "no run"
    ours, theirs = (quantiles(values)[0] for values in zip(*pairs, strict=True))
    return f"{len(pairs)} runs, {_minutes(ours)} over {_minutes(theirs)}"


def _ratio(found: Sequence[CaseResult], budget: float, detector: str) -> str:
    """Ratio of the median delays; below it if the detector's is longer than the runs."""
    (ours, _), (theirs, _) = (quantiles(delays(found, budget, name)) for name in (MONITOR, detector))
    if not isfinite(ours) or not theirs:
        return "–"
    return f"{ours / theirs:.2f}" if isfinite(theirs) else f"< {ours / AFTER_MIN:.2f}"


def _ceiling(found: Sequence[CaseResult]) -> str:
    """Share of the cases in which the oracle suspects the true cause."""
    return _share([item.oracle_suspect == item.case.fault.cause for item in found])


def _suspects(suspicions: Sequence[Suspicion], found: Sequence[CaseResult], budget: float) -> str:
    seen = [
        suspicion
        for suspicion, item in zip(suspicions, found, strict=True)
        if isfinite(item.outcomes[budget][MONITOR].delay_min)
    ]
    if not seen:
        return "nothing was detected"
    first, likely = _share([item.first for item in seen]), _share([item.likely for item in seen])
    twin = _share([item.twin_first for item in seen])
    return f"first {first}, among the likely {likely}, a twin first {twin} of {len(seen)} detected"


def _rate(rate: Rate) -> str:
    lower, upper = rate.interval_per_30_days
    return f"{rate.per_30_days:8.2f} ({lower:.2f} to {upper:.2f}; {rate.count} in {rate.watched_min / 1440:.0f} days)"


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
