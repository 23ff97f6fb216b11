"""Work of the benchmark, one function call a run, in parallel processes."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from benchmarks.faults.detectors import (
    METHODS,
    TRAINING_ROWS,
    Outcome,
    Suspicion,
    alarms_of,
    count_alarms,
    incidents_of,
    intervals_of,
    outcome_of,
    suspicion,
    watch,
)
from benchmarks.faults.oracle import log_likelihood_ratio, oracle_delay_min, oracle_suspect
from benchmarks.harness.bank import (
    AFTER_MIN,
    NOISE_SD,
    PERIOD_MIN,
    Case,
    fault_free,
    measurements_of,
    record_of,
    truth_of,
)
from benchmarks.harness.tables import poisson_interval
from benchmarks.study_figures.report_scheme import WIDTH

DAYS_30_MIN = 30 * 24 * 60.0

SOON_MIN = 10.0
"""Minutes from the first alarm to the first evaluation of the suspects."""

ORACLE, MONITOR = "oracle", "monitor"
EQUAL = "equal rate"
THREE_SIGMA = "3 sigma"

Widths = dict[str, dict[float, float]]
"""Widths of the report's limits at equal rate, by method and promised false alarms in 30 days."""


@dataclass(frozen=True)
class Rate:
    """Rate of chance events."""

    count: int  # number of events
    watched_min: float  # watched time

    @property
    def per_30_days(self) -> float:
        """The rate."""
        return self.count / self.watched_min * DAYS_30_MIN if self.watched_min else 0.0

    @property
    def interval_per_30_days(self) -> tuple[float, float]:
        """The 95 % interval of the rate, were the events independent."""
        if not self.watched_min:
            return 0.0, inf
        lower, upper = poisson_interval(self.count)
        return lower / self.watched_min * DAYS_30_MIN, upper / self.watched_min * DAYS_30_MIN


def total(rates: list[Rate]) -> Rate:
    """Rate of all together."""
    return Rate(sum(item.count for item in rates), sum(item.watched_min for item in rates))


def rows_to_false_alarm(false_alarms_per_30_days: float) -> float:
    """Mean number of rows from one false alarm to the next."""
    return DAYS_30_MIN / false_alarms_per_30_days / PERIOD_MIN


@dataclass(frozen=True)
class CaseResult:
    """Results of all detectors in a case."""

    case: Case  # case of the bank
    left_branch: bool  # whether the fault put the reactor out
    oracle_suspect: str  # suspect of the oracle at the end of the run
    outcomes: dict[float, dict[str, Outcome]]  # outcomes by promised false alarms in 30 days
    soon: dict[float, Suspicion]  # suspicion of the monitor `SOON_MIN` after its first alarm, by promised false alarms
    late: dict[float, Suspicion]  # suspicion of the monitor at the end of the run, by promised false alarms


@dataclass(frozen=True)
class FaultFreeResult:
    """Alarms in a run without a fault."""

    phi: float  # AR(1) coefficient of its noise
    alarms: dict[float, dict[str, Rate]]  # rates by promised false alarms in 30 days, then by detector
    incidents: dict[float, Rate]  # rates of the monitor's incidents, by promised false alarms
    names: dict[float, list[str]]  # names of the alarms that the monitor raised, by promised false alarms


def detectors() -> list[str]:
    """Names of all detectors, as in results."""
    report = [f"{method.name} {kind}" for kind in (EQUAL, THREE_SIGMA) for method in METHODS]
    return [ORACLE, MONITOR, *report]


def fault_free_statistics(seed: int, rows: int) -> dict[str, NDArray[np.float32]]:
    """The statistics of the report's methods on the watched rows of a run without a fault, by method."""
    record = fault_free(seed, rows)
    return {method.name: method.statistic(record)[TRAINING_ROWS:].astype(np.float32) for method in METHODS}


def run_case(case: Case, budgets: tuple[float, ...], widths: Widths) -> CaseResult:
    """Run all detectors over a case."""
    record = record_of(case)
    truth = truth_of(case, record)
    increments = log_likelihood_ratio(measurements_of(record), truth.nominal, truth.faulty, NOISE_SD)
    watched_min = record.time_min[TRAINING_ROWS:]
    statistics = {method.name: method.statistic(record)[TRAINING_ROWS:] for method in METHODS}
    end_min = case.onset_min + AFTER_MIN
    outcomes: dict[float, dict[str, Outcome]] = {}
    soon, late = {}, {}
    for budget in budgets:
        watched = watch(record, budget)
        delay_min = oracle_delay_min(record.time_min, increments, case.onset_min, rows_to_false_alarm(budget))
        monitor = outcome_of(intervals_of(watched.messages), watched.watching_since_min, case.onset_min, end_min)
        outcomes[budget] = {ORACLE: Outcome(delay_min), MONITOR: monitor} | {
            name: outcome_of(alarms_of(watched_min, statistics[method], width), watched_min[0], case.onset_min, end_min)
            for name, method, width in _charts(widths, budget)
        }
        detected_min = case.onset_min + monitor.delay_min
        soon[budget] = suspicion(watched, case.fault.cause, detected_min, detected_min + SOON_MIN)
        late[budget] = suspicion(watched, case.fault.cause, detected_min, end_min)
    return CaseResult(case, truth.left_branch, oracle_suspect(case, record, truth), outcomes, soon, late)


def run_fault_free(
    seed_and_phi: tuple[int, float], rows: int, budgets: tuple[float, ...], widths: Widths
) -> FaultFreeResult:
    """Count the alarms of a run without a fault, of a seed and with an AR(1) coefficient of its noise."""
    seed, phi = seed_and_phi
    record = fault_free(seed, rows, phi)
    statistics = {method.name: method.statistic(record)[TRAINING_ROWS:] for method in METHODS}
    report_min = (rows - TRAINING_ROWS) * PERIOD_MIN
    alarms: dict[float, dict[str, Rate]] = {}
    incidents, names = {}, {}
    for budget in budgets:
        watched = watch(record, budget)
        watched_min = max(watched.last_min - watched.watching_since_min, 0.0)
        names[budget] = [message.alarm for message in watched.messages if message.event == "raised"]
        alarms[budget] = {MONITOR: Rate(len(names[budget]), watched_min)} | {
            name: Rate(count_alarms([statistics[method]], width), report_min)
            for name, method, width in _charts(widths, budget)
        }
        incidents[budget] = Rate(incidents_of(watched.messages), watched_min)
    return FaultFreeResult(phi, alarms, incidents, names)


def _charts(widths: Widths, budget: float) -> Iterator[tuple[str, str, float]]:
    """The report's charts: name, method and width."""
    for method in METHODS:
        yield f"{method.name} {EQUAL}", method.name, widths[method.name][budget]
        yield f"{method.name} {THREE_SIGMA}", method.name, WIDTH
