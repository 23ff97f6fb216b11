"""Oracle of the cause: the best suspect that any method could name, as a bound for the monitor's.

Some causes imitate each other so well (see `bank.TWINS`) that no method distinguishes them in the noise of a run. This
oracle knows the onset, the profile, the equations, the state before the onset, the spread of the noise, and the run to
its end. For every cause that the monitor compares it fits the size, by least squares over the noise of the measurements
(Gauss and Newton's steps, halved until they gain), and it suspects the one that fits best: for independent normal noise
the likeliest, if all were equally likely before. Where a fault puts the reactor out those steps may end in a local
minimum; so that the true cause is not missed for that, its true size is tried as well.
"""

from math import inf

import numpy as np

from benchmarks.faults.bank import BANK, Case
from benchmarks.faults.runs import NOISE_SD, SIGNAL, Truth, measurements_of, profile_changes, simulator_of
from monitor_node.causes.isolation import causes_of
from reactorwatch.arrays import Array
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import SimulationError
from reactorwatch.records.record import Record

CAUSES = causes_of(cstr())

REACH = 3.0
"""Sizes up to this times the large one of the bank are tried."""

_STEPS, _HALVINGS, _GAIN = 25, 8, 0.1

_DIFFERENCE = 1e-4
"""Step of the derivatives by the size, in typical sizes."""


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
    simulator = simulator_of(effect.name, case.fault.profile)
    name = f"{effect.name}.size"
    shape = profile_changes(case, effect.name)

    def residuals_at(size: float) -> Array:
        run = simulator.run(time_min, flows, start, shape | {name: size})
        residuals: Array = ((measured - run.outputs) / NOISE_SD).ravel()
        return residuals

    def at(size: float) -> tuple[float, Array, Array]:
        """Sum of squares, residuals and their derivatives but for the sign."""
        step = -_DIFFERENCE * effect.typical  # towards sizes that are within the bounds
        step = step if effect.lower <= size + step <= effect.upper else -step
        try:
            residuals, moved = residuals_at(size), residuals_at(size + step)
        except SimulationError:  # no plant goes there
            return inf, np.zeros(1), np.zeros(1)
        return float(residuals @ residuals), residuals, (residuals - moved) / step

    largest = REACH * next(item.sizes[-1] for item in BANK if item.cause == effect.name)
    lower, upper = max(effect.lower, -largest), min(effect.upper, largest)
    size = 0.0
    squares, residuals, slopes = at(size)
    for _ in range(_STEPS):
        gradient, curvature = float(residuals @ slopes), float(slopes @ slopes)
        if not gradient**2 > _GAIN * curvature:  # what the step would gain, were the effect linear in its size
            break
        for halving in range(_HALVINGS):
            candidate = min(max(size + gradient / curvature * 0.5**halving, lower), upper)
            found = at(candidate)
            if found[0] < squares:
                break
        if not squares - found[0] > _GAIN:
            break
        size, (squares, residuals, slopes) = candidate, found
    return squares
