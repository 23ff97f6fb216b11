"""Charts of others for many signals: PCA, dynamic PCA and canonical variate analysis, with two kinds of limits.

PCA's T2 and SPE are those of MacGregor and Kourti (1995), with limits of Jackson and Mudholkar (1979); dynamic PCA adds
lagged rows (Ku, Storer and Georgakis 1995); canonical variate analysis is that of Russell, Chiang and Braatz (2000),
with the state that the past has in common with the future (Ts2), and the rest of the past (Tr2).

Textbook limits assume independent normal rows, and the parameters as known. Limits by blocked cross-validation assume
neither: the training is cut into blocks, each block is judged by the model of the others, and the limit is the quantile
of these values.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

BLOCKS = 10
EXPLAINED = 0.9
"""Share of the variance that the components of PCA explain."""
LAGS = 2
"""Past rows that dynamic PCA adds."""
WINDOW = 3
"""Rows of past and of future in canonical variate analysis."""


class Peer(Protocol):
    """A fitted method: statistics of rows."""

    @classmethod
    def fit(cls, rows: Array) -> Self:
        """Learn from rows, shape (rows, signals)."""

    def statistics(self, rows: Array) -> dict[str, Array]:
        """Statistics by name, shape (rows,) each; NaN where rows before are missing."""

    def textbook_limits(self, level: float) -> dict[str, float]:
        """Limits by name that independent normal rows exceed with a probability of 1 - `level`."""


@dataclass(frozen=True, eq=False)
class Pca:
    """Principal components of scaled rows."""

    centre: Array  # mean of each signal, shape (signals,)
    spread: Array  # standard deviation of each signal; 1 for a constant one
    directions: Array  # directions of all components, shape (signals, components), by falling variance
    variances: Array  # variance of each component
    kept: int  # number of components of T2
    rows: int  # number of rows of the training

    @classmethod
    def fit(cls, rows: Array) -> Self:
        """Learn from rows, shape (rows, signals)."""
        centre, spread = rows.mean(axis=0), rows.std(axis=0, ddof=1)
        spread = np.where(spread > 0.0, spread, 1.0)
        _, singular, directions = np.linalg.svd((rows - centre) / spread, full_matrices=False)
        variances = singular**2 / (len(rows) - 1)
        kept = int(np.searchsorted(np.cumsum(variances) / variances.sum(), EXPLAINED) + 1)
        return cls(centre, spread, directions.T, variances, min(kept, len(variances)), len(rows))

    def statistics(self, rows: Array) -> dict[str, Array]:
        """T2 of the kept components, and the squared distance from their plane (SPE)."""
        scaled = (rows - self.centre) / self.spread
        scores = scaled @ self.directions[:, : self.kept]
        rest = scaled - scores @ self.directions[:, : self.kept].T
        return {"T2": np.sum(scores**2 / self.variances[: self.kept], axis=1), "SPE": np.sum(rest**2, axis=1)}

    def textbook_limits(self, level: float) -> dict[str, float]:
        """F limit of T2; Jackson and Mudholkar's of SPE."""
        n, a = self.rows, self.kept
        rest = self.variances[a:]
        limits = {"T2": a * (n - 1) * (n + 1) / (n * (n - a)) * float(stats.f.ppf(level, a, n - a))}
        sums = [float(np.sum(rest**i)) for i in (1, 2, 3)]
        if sums[1] > 0.0:
            h = 1 - 2 * sums[0] * sums[2] / (3 * sums[1] ** 2)
            z = float(stats.norm.ppf(level))
            root = z * np.sqrt(2 * sums[1] * h**2) / sums[0] + 1 + sums[1] * h * (h - 1) / sums[0] ** 2
            limits["SPE"] = float(sums[0] * root ** (1 / h))
        return limits


@dataclass(frozen=True, eq=False)
class DynamicPca:
    """PCA of rows with the rows before them."""

    pca: Pca  # components of the stacked rows

    @classmethod
    def fit(cls, rows: Array) -> Self:
        """Learn from rows, shape (rows, signals)."""
        return cls(Pca.fit(stack(rows, LAGS)[LAGS:]))

    def statistics(self, rows: Array) -> dict[str, Array]:
        """As of PCA; NaN in the first rows."""
        found = self.pca.statistics(stack(rows, LAGS)[LAGS:])
        return {name: np.concatenate([np.full(LAGS, np.nan), values]) for name, values in found.items()}

    def textbook_limits(self, level: float) -> dict[str, float]:
        """As of PCA, with its number of rows."""
        return self.pca.textbook_limits(level)


@dataclass(frozen=True, eq=False)
class CanonicalVariates:
    """Canonical variates of the past rows with the future ones."""

    centre: Array  # mean of each signal
    spread: Array  # standard deviation of each signal; 1 for a constant one
    whitening: Array  # matrix that makes the past white, shape (past, past)
    state: Array  # directions of the state in the whitened past, shape (past, states)
    rows: int  # number of rows of the training

    @classmethod
    def fit(cls, rows: Array) -> Self:
        """Learn from rows, shape (rows, signals); the state explains `EXPLAINED` of the squared correlations."""
        centre, spread = rows.mean(axis=0), rows.std(axis=0, ddof=1)
        spread = np.where(spread > 0.0, spread, 1.0)
        past, future = _past_and_future((rows - centre) / spread)
        past, future = past - past.mean(axis=0), future - future.mean(axis=0)
        count = len(past) - 1
        whitening, of_future = _inverse_root(past.T @ past / count), _inverse_root(future.T @ future / count)
        left, correlations, _ = np.linalg.svd(whitening @ (past.T @ future / count) @ of_future)
        share = np.cumsum(correlations**2) / np.sum(correlations**2)
        states = min(int(np.searchsorted(share, EXPLAINED) + 1), left.shape[1] - 1)
        return cls(centre, spread, whitening, left[:, :states], len(past))

    def statistics(self, rows: Array) -> dict[str, Array]:
        """Ts2 of the state and Tr2 of the rest of the past; NaN in the first rows."""
        past = stack((rows - self.centre) / self.spread, WINDOW - 1)[WINDOW - 1 :] @ self.whitening.T
        scores = past @ self.state
        rest = past - scores @ self.state.T
        lead = np.full(WINDOW - 1, np.nan)
        return {
            "Ts2": np.concatenate([lead, np.sum(scores**2, axis=1)]),
            "Tr2": np.concatenate([lead, np.sum(rest**2, axis=1)]),
        }

    def textbook_limits(self, level: float) -> dict[str, float]:
        """F limits of both."""
        n, k = self.rows, self.state.shape[1]
        sizes = {"Ts2": k, "Tr2": self.whitening.shape[0] - k}
        return {
            name: a * (n**2 - 1) / (n * (n - a)) * float(stats.f.ppf(level, a, n - a)) if n > a else float("nan")
            for name, a in sizes.items()
        }


PEERS: dict[str, type[Peer]] = {"PCA": Pca, "DPCA": DynamicPca, "CVA": CanonicalVariates}


def _identity(values: Array) -> Array:
    return values


def cross_validated_limits(
    peer: type[Peer],
    rows: Array,
    level: float,
    blocks: int = BLOCKS,
    transform: Callable[[Array], Array] = _identity,
) -> dict[str, float]:
    """Limits by blocked cross-validation."""
    held_out = _judge_blocks(peer.fit, rows, blocks, transform)
    return {name: float(np.nanquantile(values, level)) for name, values in held_out.items()}


def _judge_blocks(
    fit: Callable[[Array], Peer], rows: Array, blocks: int, transform: Callable[[Array], Array]
) -> dict[str, Array]:
    """Statistics of each block by the model of the others."""
    found: dict[str, list[Array]] = {}
    edges = np.linspace(0, len(rows), blocks + 1).astype(int)
    for begin, end in pairwise(edges):
        model = fit(np.concatenate([rows[:begin], rows[end:]]))
        for name, values in model.statistics(rows[begin:end]).items():
            found.setdefault(name, []).append(transform(values))
    return {name: np.concatenate(parts) for name, parts in found.items()}


def smooth(values: Array, weight: float) -> Array:
    """Exponentially weighted mean of a statistic, shape (rows,); rows without a value are passed over."""
    smoothed, level = np.full(values.size, np.nan), np.nan
    for k, value in enumerate(values):
        if np.isfinite(value):
            level = value if np.isnan(level) else (1 - weight) * level + weight * value
        smoothed[k] = level
    return smoothed


def stack(rows: Array, lags: int) -> Array:
    """Each row followed by the rows before it, shape (rows, signals (lags + 1)); the first `lags` rows wrap around."""
    return np.concatenate([np.roll(rows, lag, axis=0) for lag in range(lags + 1)], axis=1)


def _past_and_future(rows: Array) -> tuple[Array, Array]:
    """Stacked past, newest row first, and stacked future of each row that has both."""
    last = len(rows) - WINDOW
    past = stack(rows, WINDOW - 1)[WINDOW - 1 : last]
    future = np.concatenate([rows[WINDOW - 1 + i : last + i] for i in range(1, WINDOW + 1)], axis=1)
    return past, future


def _inverse_root(covariance: Array) -> Array:
    """Symmetric inverse square root; directions without variance are left out."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > values[-1] * 1e-10
    return np.asarray((vectors[:, kept] / np.sqrt(values[kept])) @ vectors[:, kept].T)
