"""Oracle: the best detector that knows the fault, as a bound on the delay of any detector.

It knows the cause, the profile, the size, the onset, the equations, their initial state and the spread of the noise. So
it knows what a sensor without noise would have shown without the fault, y0[k], and with it, y1[k], and for independent
normal noise the logarithm of the likelihood ratio of all rows since the onset is

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

from math import inf, log

import numpy as np
from scipy.optimize import least_squares

from benchmarks.harness.bank import (
    BANK,
    NOISE_SD,
    SIGNAL,
    Case,
    Truth,
    measurements_of,
    profile_changes,
    simulator_of,
)
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
