"""Work of the benchmark, one function call a run, with the oracle as the bound of any detector.

The oracle is the best detector that knows the fault: the cause, the profile, the size, the onset, the equations, their
initial state and the spread of the noise. So it knows what a sensor without noise would have shown without the fault,
y0[k], and with it, y1[k], and for independent normal noise the logarithm of the likelihood ratio of all rows since the
onset is

    L[n] = sum_k sum_signals ((y[k] - y0[k])^2 - (y[k] - y1[k])^2) / (2 sd^2).

It signals at the first row at which L reaches ln(ARL0), ARL0 being the rows to a false alarm that are promised. That is
the threshold of a detector which knows everything but the onset: Page's test, the largest L over all onsets, against
ln(ARL0) has a mean run length of at least ARL0, and no test of that run length has an asymptotically smaller worst
mean delay (Lorden 1971, Procedures for reacting to a change in distribution, Annals of Mathematical Statistics 42,
1897-1908).

Limits of the definition: Page's test looks at other onsets as well and so signals no later than this one; and the bound
on its run length is not met exactly, so a slightly lower threshold would still keep the promise. Both are a few tenths
of the delay of a small fault. A single run of a real detector may beat the oracle by luck; the median may not, by much.
The plant of the bank has no process noise, without which y0 and y1 are exact.

Some causes imitate each other so well (see `TWINS`) that no method distinguishes them in the noise of a run. So there
is an oracle of the cause as well, as a bound for the monitor's suspects. It knows the onset, the profile, the
equations, the state before the onset, the spread of the noise, and the run to its end. For every cause that the monitor
compares it fits the size by least squares over the noise, and it suspects the cause that fits best. Where a fault puts
the reactor out the fit may end in a local minimum; so that the true cause is not missed for that, its true size is
tried as well.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, log

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

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
from benchmarks.harness.bank import (
    AFTER_MIN,
    BANK,
    NOISE_SD,
    PERIOD_MIN,
    SIGNAL,
    Case,
    Truth,
    fault_free,
    measurements_of,
    profile_changes,
    record_of,
    simulator_of,
    truth_of,
)
from benchmarks.harness.study import poisson_interval
from benchmarks.study_figures.report_scheme import WIDTH
from monitor_node.causes.isolation import causes_of
from reactorwatch.arrays import Array
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import SimulationError
from reactorwatch.records.record import Record

CAUSES = causes_of(cstr())

REACH = 3.0
"""Sizes up to this times the large one of the bank are tried."""


def log_likelihood_ratio(measured: Array, nominal: Array, faulty: Array, noise_sd: Array) -> Array:
    """Increments of L of each row, shape (rows,)."""
    squares = ((measured - nominal) ** 2 - (measured - faulty) ** 2) / (2 * noise_sd**2)
    return np.asarray(squares.sum(axis=1))


def oracle_delay_min(time_min: Array, increments: Array, onset_min: float, rows_to_false_alarm: float) -> float:
    """Minutes from the onset to the oracle's signal; inf if it does not come."""
    since = time_min >= onset_min
    reached = np.cumsum(increments[since]) >= log(rows_to_false_alarm)
    return float(time_min[since][np.argmax(reached)] - onset_min) if reached.any() else inf


def oracle_suspect(case: Case, record: Record, truth: Truth) -> str:
    """The cause that explains a run best."""
    since = int(np.argmax(record.time_min >= case.onset_min)) - 1
    misfits = {effect.name: _misfit(effect, case, record, truth, since) for effect in CAUSES}
    at_true_size = float(np.sum(((measurements_of(record) - truth.faulty)[since:] / NOISE_SD) ** 2))
    misfits[case.fault.cause] = min(misfits[case.fault.cause], at_true_size)
    return min(misfits, key=misfits.__getitem__)


def _misfit(effect: Effect, case: Case, record: Record, truth: Truth, since: int) -> float:
    """The least sum of squares that an effect of any size leaves from a row on, over the variance of the noise."""
    time_min, flows = record.time_min[since:], record.columns[SIGNAL][since:]
    measured, start = measurements_of(record)[since:], truth.nominal_states[since]
    simulator, shape = simulator_of(effect.name, case.fault.profile), profile_changes(case, effect.name)
    unit, _, largest = next(item.sizes for item in BANK if item.cause == effect.name)

    def residuals(size: Array) -> Array:
        changes = shape | {f"{effect.name}.size": unit * float(size[0])}
        try:
            return np.ravel((measured - simulator.run(time_min, flows, start, changes).outputs) / NOISE_SD)
        except SimulationError:  # no plant goes there
            return np.full(measured.size, 1e3)

    bounds = max(effect.lower, -REACH * largest) / unit, min(effect.upper, REACH * largest) / unit
    return 2.0 * float(least_squares(residuals, 0.01, bounds=bounds, ftol=1e-6).cost)


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
