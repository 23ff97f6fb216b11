"""Every cause at every onset at once: the generalised likelihood ratio, linearised.

If a deviation of size m sets in, the innovations of a filter that does not know of it are no longer white: whitened,
they have the mean m g, where the signature g follows from the equations of the filter itself. With S the derivative
of the filter's state with respect to m, between two rows and at a row

    S <- F S + G,        g = L^-1 (H S + D),        S <- S - K (H S + D),

with F, G the derivatives of the way between the rows with respect to state and m, H, D those of the outputs, K the
filter's gain and L L' the covariance of its innovations; from row to row it is one product with S (see
`error_dynamics`). For a given cause and onset the likeliest size is a / b, with
a = sum(g w) and b = sum(g g) over the whitened innovations w, its variance is 1 / b, and twice the logarithm of the
likelihood ratio a^2 / b (Willsky & Jones 1976, A generalized likelihood ratio approach to the detection and
estimation of jumps in linear systems, IEEE Trans. Automatic Control 21).

All causes, profiles and candidate onsets are columns of one S, so a row costs a few small matrix products. They
are ever more thinly spread the older they are: seen from the last row first, and if something stood out before, a
second time from there. The signature of an onset between two candidates is about what
lies between theirs: with sum(g g) of neighbours, these cost next to nothing.

The signature is that of an infinitesimal size. A large fault soon leads the plant where it no longer holds, so there
are two scans: of the rows up to the first at which some cause stands out by `STANDS_OUT`, and of all.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from monitor_node.isolation.error_dynamics import Linearisation, Ways
from monitor_node.isolation.window import Window
from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf import NoiseLevels
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

PROFILES = ("step", "ramp")
"""How a deviation goes in time. The size of a ramp is its slope here, in a minute."""

STANDS_OUT = 60.0
"""Twice a logarithm of a likelihood ratio."""

REACH = 30.0
"""Likewise: an onset that is worse than the best one by more is out of question."""

_SPREAD = 16.0
_BETWEEN = (0.25, 0.5, 0.75)


@dataclass(frozen=True, eq=False)
class Scan:
    """What the linearised bank finds.

    Attributes:
        rows: how many rows it rests on.
        onset_min: when a deviation may set in, shape (n,), increasing.
        size: the likeliest, shape (n, profiles, causes).
        ratio: twice the logarithm of its likelihood ratio, shape (n, profiles, causes); minus infinity: not known.
        information: 1 / variance of the size, likewise.
    """

    rows: int
    onset_min: Array
    size: Array
    ratio: Array
    information: Array


class Bank:
    """The signatures of all causes.

    Args:
        model: of the plant.
        noise: of the plant and its sensors.
        effects: the causes; each has to act on the model's own states.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, effects: Sequence[Effect]) -> None:
        self._count = len(effects)
        self._lower = np.array([effect.lower for effect in effects])
        self._upper = np.array([effect.upper for effect in effects])
        self._linearisation = Linearisation(model, noise, effects)

    def prepare(self) -> None:
        """Compile now what the first scan would compile."""
        self._linearisation.prepare()

    def scan(self, window: Window) -> tuple[Scan, Scan]:
        """Compare all causes on the rows up to the first at which one stands out, and on all.

        Args:
            window: the rows, and the filter's run over them. Where it lost the plant signatures may overflow; the ratio
                is then minus infinity.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            return self._scans(window)

    def _scans(self, window: Window) -> tuple[Scan, Scan]:
        ways, rows = self._linearisation.ways(window), window.time_min.size
        early = self._scanned(window, ways, spread_onsets(window.first_onset, rows), no_further=True)[0]
        if early.rows == rows:
            return early, early
        near = np.max(early.ratio, axis=(1, 2)) > np.max(early.ratio) - REACH
        before = max(int(np.argmax(near)) - len(_BETWEEN) - 1, 0)
        first = int(np.searchsorted(window.time_min, early.onset_min[before], side="right")) - 1
        return self._scanned(window, ways, spread_onsets(max(first, window.first_onset), early.rows))

    def _scanned(
        self, window: Window, ways: Ways, onsets: NDArray[np.int64], *, no_further: bool = False
    ) -> tuple[Scan, Scan]:
        """What is found up to the first row at which a cause stands out, and on all rows if they are wanted."""
        times, start, n_x = window.time_min, window.time_min[onsets], ways.A.shape[2]
        width, half = len(PROFILES) * self._count, 0.5 * np.diff(times)
        set_in = np.searchsorted(onsets, np.arange(times.size + 1)).tolist()  # how many before each row
        S = np.zeros((n_x, onsets.size * width))
        a, b, c = np.zeros((3, onsets.size * width))  # c: of neighbours, each with the next one
        early: Scan | None = None
        for row in range(int(onsets[0]), times.size):
            way = row - 1  # that leads to this row
            before, shown = set_in[row], set_in[row + 1] * width
            G, D = ways.G[way][:, None], ways.D[way][:, None]
            both = np.zeros((len(G), set_in[row + 1], len(PROFILES), self._count))  # S after this row, then g
            both[:, :before] = (ways.A[way] @ S[:, : before * width]).reshape(both[:, :before].shape)
            both[:, :before, 0] += G + D
            both[:, :before, 1] += (G + D) * (times[row] - start[:before])[:, None] - G * half[way]
            both[:, before:, 0] = D  # what sets in at this row shows at once, but has not acted yet
            after = both.reshape(len(G), shown)
            S[:, :shown], g = after[:n_x], after[n_x:]
            a[:shown] += ways.w[way] @ g
            b[:shown] += np.einsum("ij,ij->j", g, g)
            c[: shown - width] += np.einsum("ij,ij->j", g[:, :-width], g[:, width:])
            if early is None and np.max(a[:shown] ** 2 - STANDS_OUT * b[:shown]) > 0.0:
                early = self._scan(row + 1, start, a, b, c)
                if no_further:
                    return early, early
        whole = self._scan(times.size, start, a, b, c)
        return early or whole, whole

    def _scan(self, rows: int, onset_min: Array, a: Array, b: Array, c: Array) -> Scan:
        a, b, c = (item.reshape(onset_min.size, len(PROFILES), self._count) for item in (a, b, c))
        near, far = np.arange(onset_min.size - 1), np.arange(1, onset_min.size)
        parts = [(onset_min, a, b)]
        for share in _BETWEEN:
            rest = 1.0 - share
            squares = rest**2 * b[near] + 2.0 * rest * share * c[near] + share**2 * b[far]
            parts.append((rest * onset_min[near] + share * onset_min[far], rest * a[near] + share * a[far], squares))
        onset_min, a, b = (np.concatenate(items) for items in zip(*parts, strict=True))
        order = np.argsort(onset_min, kind="stable")
        onset_min, a, b = onset_min[order], a[order], b[order]
        size = np.clip(a / np.maximum(b, 1e-300), self._lower, self._upper)
        ratio = size * (2.0 * a - size * b)
        return Scan(rows, onset_min, size, np.where(np.isfinite(ratio), ratio, -np.inf), b)


def spread_onsets(first: int, rows: int) -> NDArray[np.int64]:
    """Rows at which a deviation may set in: all of the newest, older ones ever more thinly spread."""
    found, row = [], rows - 1
    while row > first:
        found.append(row)
        age = rows - row
        row -= int(np.ceil(age / _SPREAD))
    return np.array([first, *reversed(found)], dtype=np.int64)
