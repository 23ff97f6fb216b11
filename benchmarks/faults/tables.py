"""Output of the benchmark: the table by fault and size, and the summary lines."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from math import exp, inf, isfinite
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.faults.bank import AFTER_MIN, BANK, GRADES
from benchmarks.faults.report_method import METHODS
from benchmarks.faults.score import DAYS_30_MIN, Delays, Rate
from benchmarks.faults.study import (
    MONITOR,
    ORACLE,
    SOON_MIN,
    CaseResult,
    FaultFreeResult,
    Widths,
    detectors,
)
from benchmarks.faults.watch import LIKELY, Suspicion


def delays(results: Sequence[CaseResult], budget: float, detector: str) -> Delays:
    """Delays of a detector in some cases."""
    return Delays.of([item.outcomes[budget][detector].delay_min for item in results])


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
            console.print(f"    {detector:<15}{_rate(Rate.total([item.alarms[budget][detector] for item in found]))}")
        console.print(
            f"    {'incidents':<15}{_rate(Rate.total([item.incidents[budget] for item in found]))}  (monitor)"
        )
        names = Counter(name for item in found for name in item.names[budget])
        runs = sum(bool(item.names[budget]) for item in found)
        said = ", ".join(f"{name} {count}" for name, count in names.most_common())
        console.print(f"    the monitor's alarms came in {runs} runs: {said or 'none'}")


def as_json(
    results: Sequence[CaseResult], quiet: Sequence[FaultFreeResult], budgets: Sequence[float], widths: Widths
) -> dict[str, Any]:
    """The numbers behind it all, run by run; a delay is null where nothing was detected."""
    return {
        "widths": {name: {f"{budget:g}": value for budget, value in item.items()} for name, item in widths.items()},
        "faults": [
            {
                "cause": item.case.fault.cause,
                "profile": item.case.fault.profile,
                "grade": item.case.grade,
                "size": item.case.size,
                "onset_min": item.case.onset_min,
                "seed": item.case.seed,
                "left_branch": item.left_branch,
                "oracle_suspect": item.oracle_suspect,
                "budget": budget,
                "delay_min": {
                    name: outcome.delay_min if isfinite(outcome.delay_min) else None
                    for name, outcome in item.outcomes[budget].items()
                },
                "false_alarms": {name: outcome.false_alarms for name, outcome in item.outcomes[budget].items()},
                "suspicion_soon": asdict(item.soon[budget]),
                "suspicion_late": asdict(item.late[budget]),
            }
            for budget in budgets
            for item in results
        ],
        "fault_free": [
            {
                "phi": item.phi,
                "budget": budget,
                "false_alarms": {name: rate.count for name, rate in item.alarms[budget].items()},
                "incidents": item.incidents[budget].count,
                "alarms": item.names[budget],
                "watched_min": item.alarms[budget][MONITOR].watched_min,
            }
            for budget in budgets
            for item in quiet
        ],
    }


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


def _cell(found: Delays) -> str:
    return f"{found.detected:.0%} {_minutes(found.median_min)} / {_minutes(found.slow_min)}"


def _minutes(value: float) -> str:
    if not isfinite(value):
        return "–"
    return f"{value:.2f}" if value < 10 else f"{value:.1f}"


def _share(values: Sequence[bool]) -> str:
    return f"{sum(values) / len(values):.0%}"


def _quotient(ours_min: float, theirs_min: float) -> tuple[float, str]:
    """A ratio of delays, and `<` if their delay is longer than the runs, so that the ratio is a bound."""
    if not isfinite(ours_min):
        return inf, ""
    if not isfinite(theirs_min):
        return ours_min / AFTER_MIN, "< "
    return ours_min / theirs_min if theirs_min else inf, ""


def _both(found: Sequence[CaseResult], budget: float, detector: str) -> str:
    """The same over the runs in which both detect."""
    pairs = [
        (item.outcomes[budget][MONITOR].delay_min, item.outcomes[budget][detector].delay_min)
        for item in found
        if isfinite(item.outcomes[budget][MONITOR].delay_min) and isfinite(item.outcomes[budget][detector].delay_min)
    ]
    if not pairs:
        return "no run"
    ours, theirs = (Delays.of(values).median_min for values in zip(*pairs, strict=True))
    return f"{len(pairs)} runs, {_minutes(ours)} over {_minutes(theirs)}"


def _ratio(found: Sequence[CaseResult], budget: float, detector: str) -> str:
    value, bound = _quotient(delays(found, budget, MONITOR).median_min, delays(found, budget, detector).median_min)
    return f"{bound}{value:.2f}" if isfinite(value) else "–"


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
