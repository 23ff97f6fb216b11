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
"""

from math import inf, log

import numpy as np

from reactorwatch.arrays import Array


def log_likelihood_ratio(measured: Array, nominal: Array, faulty: Array, noise_sd: Array) -> Array:
    """Increments of L of each row, shape (rows,)."""
    squares = ((measured - nominal) ** 2 - (measured - faulty) ** 2) / (2 * noise_sd**2)
    return np.asarray(squares.sum(axis=1))


def oracle_delay_min(time_min: Array, increments: Array, onset_min: float, rows_to_false_alarm: float) -> float:
    """Minutes from the onset to the oracle's signal; inf if it does not come."""
    since = time_min >= onset_min
    reached = np.cumsum(increments[since]) >= log(rows_to_false_alarm)
    return float(time_min[since][np.argmax(reached)] - onset_min) if reached.any() else inf
