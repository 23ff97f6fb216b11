"""Run length of the CUSUM: Page's integral equation, and how the two sides combine.

One side, started at u, that stays at 0 with a probability and otherwise moves over (0, h] (Page 1954; Brook & Evans
1972 solve the same by a chain):

    L(u) = 1 + L(0) Phi(k - u - shift) + integral from 0 to h of L(y) phi(y + k - u - shift) dy.

Two sides, started at u and v (Lucas & Crosier 1982, appendix; Van Dobben de Bruyn 1968 for u = v = 0): if the low
sum is 0 whenever the high one signals, and the other way round, the side that signals first leaves the other in its
initial state, and therefore

    L(u, v) = (L+(u) L-(0) + L-(v) L+(0) - L+(0) L-(0)) / (L+(0) + L-(0)).

That is so for u + v <= h + 2 k: at a signal of the high sum after n samples the values less the mean sum to
more than h - u + n k, so the low one is below v + u - h - 2 n k. For a head start beyond h / 2 + k there is no such
formula, and the function raises.

In the steady state L is averaged over the sums as they are after long without a signal. It is linear in L+(u) and
L-(v), so the distribution of each sum by itself is all that is needed. It is taken as that of a one-sided chart, which
leaves out that the other side has not signalled either: less than 0.1 % of the run length if a false alarm comes every
100 samples or less often, 0.5 % at every 20 (held against the chain of both sums in the tests).
"""

from math import ceil, isinf

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.run_length.arguments import check_length, check_range, shift_size
from reactorwatch.spc.run_length.chain import nodes, run_lengths, stationary_distribution

LARGEST_LIMIT, LARGEST_ALLOWANCE = 200.0, 100.0


def cusum(
    shift: float,
    k: float = 0.5,
    h: float = 5.0,
    head_start: float = 0.0,
    *,
    one_sided: bool = False,
    steady_state: bool = False,
) -> float:
    """Average run length.

    >>> round(cusum(1.0, k=0.5, h=5.0), 2)
    10.38

    Args:
        shift: shift of the mean, in sigma; its sign counts for the one-sided chart only.
        k: allowance, in sigma.
        h: limit, in sigma, at most 200.
        head_start: initial value of both sums, in sigma.
        one_sided: whether there is the high sum only.
        steady_state: whether the chart has long run when the shift occurs; the head start is forgotten then.

    Raises:
        InputError: an argument out of its range.
    """
    check_parameters(k, h, head_start)
    check_range("h", h, 1e-3, LARGEST_LIMIT)
    check_range("k", k, 0.0, LARGEST_ALLOWANCE)
    size = shift_size(shift)
    if one_sided:
        return check_length(_one_side(shift, k, h, head_start, steady_state)[1])
    if head_start > 0.5 * h + k and not steady_state:
        raise InputError(f"head_start must be at most h/2 + k = {0.5 * h + k:g} for two sides, got {head_start}")
    high_0, high = _one_side(size, k, h, head_start, steady_state)
    low_0, low = _one_side(-size, k, h, head_start, steady_state)
    if isinf(low_0):
        return check_length(high)
    return check_length((high * low_0 + low * high_0 - high_0 * low_0) / (high_0 + low_0))


def check_parameters(k: float, h: float, head_start: float) -> None:
    """Check the parameters of a chart.

    Raises:
        InputError: one is out of its range.
    """
    positive("h", h)
    if not 0.0 <= k < float("inf"):
        raise InputError(f"k must be a number of at least 0, got {k}")
    if not 0.0 <= head_start <= h:
        raise InputError(f"head_start must be in [0, h] = [0, {h}], got {head_start}")


def _one_side(shift: float, k: float, h: float, head_start: float, steady_state: bool) -> tuple[float, float]:
    """Run length of the high sum from 0, and from the head start or in the steady state."""
    states = np.concatenate([[0.0], _nodes(h)[0]])
    lengths = run_lengths(_transitions(states, shift, k, h))
    at_zero = float(lengths[0])
    if isinf(at_zero):
        return at_zero, at_zero
    if steady_state:
        return at_zero, float(stationary_distribution(_transitions(states, 0.0, k, h)) @ lengths)
    if head_start == 0.0:
        return at_zero, at_zero
    return at_zero, float(1.0 + _transitions(np.array([head_start]), shift, k, h)[0] @ lengths)


def _transitions(states: Array, shift: float, k: float, h: float) -> Array:
    """Transitions from the given sums to 0 and to the nodes."""
    points, weights = _nodes(h)
    to_zero = special.ndtr(k - shift - states)
    off = points[None, :] + (k - shift - states)[:, None]
    return np.column_stack([to_zero, weights * np.exp(-0.5 * off * off) / np.sqrt(2.0 * np.pi)])


def _nodes(h: float) -> tuple[Array, Array]:
    return nodes(0.0, h, 32 + ceil(3.0 * h))
