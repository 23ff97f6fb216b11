"""Rate of a signal's outliers: only a change of it is an alarm.

A sensor may have outliers at a steady rate as long as it is sound. Of n in the N rows of a training the rate is gamma
distributed, and the number in the next R rows negative binomial,

    rate ~ Gamma(n + 1, N),    count ~ NB(n + 1, N / (N + R))

(Hahn & Meeker 1991, Statistical Intervals, ch. 7). A spike is then an alarm if there have been so many in the last R
rows that chance has as many no more often than once in `arl0` rows. A signal without outliers in its training has an
alarm at each.
"""

import msgspec
from scipy.special import nbdtrc

SHARE = 0.5
"""Length of the window in which spikes are counted, in lengths of the training."""

MOST = 10_000


class SpikeRate(msgspec.Struct, array_like=True):
    """Decides which spike is an alarm; the object is its own state.

    Attributes:
        outliers: number of outliers in the training.
        window_ns: length of the window in which spikes are counted.
        limit: number of spikes in the window that is an alarm.
        recent_ns: times of the newest spikes in the window, oldest first.
    """

    outliers: int
    window_ns: int
    limit: int
    recent_ns: list[int]

    @classmethod
    def learn(cls, count: int, rows: int, period_ns: float, arl0: float) -> "SpikeRate":
        """Learn from a training.

        Args:
            count: number of outliers in it.
            rows: number of its rows.
            period_ns: sampling period.
            arl0: least mean number of rows between two false alarms.
        """
        window = max(int(SHARE * rows), 1)
        return cls(count, round(window * period_ns), spike_count_limit(count, rows, window, arl0), [])

    @property
    def usual(self) -> float:
        """Number of spikes that are usual in the window."""
        return SHARE * self.outliers

    @property
    def window_min(self) -> float:
        """Length of the window in minutes."""
        return self.window_ns / 60e9

    def add(self, time_ns: int) -> int:
        """Count a spike; returns the number in the window if it is an alarm, else 0."""
        recent = self.recent_ns
        recent.append(time_ns)
        while time_ns - recent[0] > self.window_ns or recent[0] > time_ns:
            del recent[0]
        if len(recent) < self.limit:
            return 0
        count = len(recent)
        recent.clear()
        return count


def spike_count_limit(count: int, rows: int, window: int, arl0: float) -> int:
    """Number of spikes in a window that chance has at most once in `arl0` rows.

    >>> [spike_count_limit(count, 1000, 500, 3e6) for count in (0, 1, 5, 20)]
    [1, 11, 18, 34]

    Args:
        count: number of outliers in the training.
        rows: number of rows of the training.
        window: length of the window in rows.
        arl0: least mean number of rows between two false alarms.
    """
    if not count:
        return 1
    rate, share = (count + 1) / rows, rows / (rows + window)
    for others in range(MOST):
        # nbdtrc(k, n, p): probability of more than k
        if rate * (float(nbdtrc(others - 1, count + 1, share)) if others else 1.0) <= 1.0 / arl0:
            return others + 1
    return MOST
