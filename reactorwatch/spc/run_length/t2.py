"""Run length of Hotelling's T2 with known covariance: every sample is independent of the others.

T2 is chi-square with p degrees of freedom and the non-centrality shift^2; the run length is geometric.
"""

from scipy import special

from reactorwatch.errors import positive
from reactorwatch.spc.run_length.arguments import check_length, check_range, shift_size

LARGEST_DIMENSION = 100


def t2(shift: float, dimension: int, limit: float) -> float:
    """Average run length, the same for zero and steady state.

    >>> round(t2(1.0, 2, 10.597), 2)
    41.92

    Args:
        shift: Mahalanobis distance of the shift of the mean.
        dimension: number of signals, p, at most 100.
        limit: limit of T2.

    Raises:
        InputError: an argument out of its range.
    """
    positive("limit", limit)
    check_range("dimension", dimension, 1, LARGEST_DIMENSION)
    size = shift_size(shift)
    if size == 0.0:
        return check_length(1.0 / max(float(special.chdtrc(dimension, limit)), 1e-300))
    from scipy import stats  # takes longer to import than all else here to compute

    return check_length(1.0 / max(float(stats.ncx2.sf(limit, dimension, size * size)), 1e-300))
