"""Multiple PCA with soft partition: each regime of a plant has principal components, and rows belong to all of them.

A plant that is run at several loads has one cloud of rows at each, and the components of all together see nothing
within a cloud. Gaussian memberships (the posterior probabilities of a mixture, by expectation maximisation: Dempster,
Laird & Rubin 1977, J. R. Statist. Soc. B 39) divide the rows; weighted by them, each regime g has a mean, components,
and T2 and SPE of a row, divided by their means (Zhao, Zhang & Xu 2004, Monitoring of processes with multiple operating
modes through multiple principle component analysis models, Ind. Eng. Chem. Res. 43). The chart takes

    T2 = sum of m_g(x) T2_g(x),    SPE = sum of m_g(x) SPE_g(x),      m_g: memberships of the row,

so that a row between two regimes is judged by both. The number of regimes has the least BIC. Memberships are computed
from the first three components of all rows together, and a regime has three rows or more for each signal. Held-out
blocks are spread over the training, which may have seen a regime only once.
"""

from typing import NamedTuple, Self

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.spc.charts.base import Setting
from reactorwatch.spc.charts.pca import Components, standardise
from reactorwatch.spc.charts.value_chart import Model, StatisticsChart, ValueBaseline


class Mixture(NamedTuple):
    """Gaussian mixture.

    Attributes:
        shares: share of each regime, shape (regimes,).
        means: shape (regimes, dimensions).
        roots: matrices that make the deviations of a regime white, shape (regimes, dimensions, dimensions).
    """

    shares: Array
    means: Array
    roots: Array

    @classmethod
    def of_memberships(cls, rows: Array, memberships: Array) -> Self:
        """The mixture that is most likely, given memberships of shape (rows, regimes)."""
        counts = memberships.sum(axis=0)
        means = memberships.T @ rows / counts[:, None]
        ridge = 1e-3 * np.diag(rows.var(axis=0))  # least variance of a regime, of that of all rows, in every direction
        off = rows[None] - means[:, None]
        covariances = np.einsum("ng,gni,gnj->gij", memberships, off, off) / counts[:, None, None] + ridge
        return cls(counts / len(rows), means, np.linalg.inv(np.linalg.cholesky(covariances)))

    def log_densities(self, rows: Array) -> Array:
        """Logarithm of share times density of each regime, shape (rows, regimes)."""
        white = np.einsum("gij,ngj->ngi", self.roots, rows[:, None] - self.means)
        scales = np.sum(np.log(np.diagonal(self.roots, axis1=1, axis2=2)), axis=1)
        constant = 0.5 * rows.shape[1] * np.log(2.0 * np.pi)
        return np.asarray(np.log(self.shares) + scales - constant - 0.5 * np.sum(white**2, axis=2))

    def memberships(self, rows: Array) -> Array:
        """Posterior probabilities of the regimes, shape (rows, regimes)."""
        return np.asarray(special.softmax(self.log_densities(rows), axis=1))

    def log_likelihood(self, rows: Array) -> float:
        """Logarithm of the likelihood of rows."""
        return float(np.sum(special.logsumexp(self.log_densities(rows), axis=1)))


def fit_mixture(rows: Array, regimes: int, fewest: float) -> Mixture:
    """The mixture of at most so many regimes with the least BIC.

    Args:
        rows: shape (rows, dimensions).
        regimes: largest number of regimes.
        fewest: least number of rows of a regime.
    """
    best = Mixture.of_memberships(rows, np.ones((len(rows), 1)))
    least = _bic(best, rows)
    for count in range(2, regimes + 1):
        for start in range(4):
            rng = np.random.default_rng(20_261_123 + start)  # always the same starts
            mixture = maximise(rows, divide(rows, count, rng), fewest)
            if mixture is not None and _bic(mixture, rows) < least:
                best, least = mixture, _bic(mixture, rows)
    return best


def maximise(rows: Array, memberships: Array, fewest: float) -> Mixture | None:
    """Expectation maximisation from memberships on; None if a regime loses its rows."""
    last = -np.inf
    for _ in range(200):
        if memberships.sum(axis=0).min() < fewest:
            return None
        mixture = Mixture.of_memberships(rows, memberships)
        likelihood, memberships = mixture.log_likelihood(rows), mixture.memberships(rows)
        if likelihood - last < 1e-6 * len(rows):
            break
        last = likelihood
    return mixture


def divide(rows: Array, count: int, rng: np.random.Generator) -> Array:
    """Memberships of the nearest of some rows, each drawn far from those before (k-means++)."""
    centres = rows[rng.integers(len(rows))][None]
    for _ in range(count - 1):
        nearest = np.min(np.sum((rows[:, None] - centres) ** 2, axis=2), axis=1)
        centres = np.vstack([centres, rows[rng.choice(len(rows), p=nearest / nearest.sum())]])
    nearest = np.argmin(np.sum((rows[:, None] - centres) ** 2, axis=2), axis=1)
    return np.asarray(np.eye(count)[nearest])


def _bic(mixture: Mixture, rows: Array) -> float:
    regimes, dimension = mixture.means.shape
    parameters = regimes * (1 + dimension + dimension * (dimension + 1) / 2) - 1
    return float(parameters * np.log(len(rows)) - 2.0 * mixture.log_likelihood(rows))


class MultiplePca(StatisticsChart):
    """T2 and SPE of the regimes of a plant, weighted by the memberships of a row."""

    name = "multiple_pca"
    settings = (Setting("multiple_pca_weight", 0.1, 0.01, 1.0), Setting("multiple_pca_regimes", 4, 1, 10))
    labels = ("T2", "SPE")
    weight_key = "multiple_pca_weight"
    reason = "in its regime is unlike the training"
    fewest_signals = 3
    pieces = 4
    is_skewed = True  # a plant stays away from the middle of its regimes for long after a move

    @classmethod
    def fit(cls, values: Array, baseline: ValueBaseline) -> Model:
        """See `StatisticsChart`."""
        centre, scale, z = standardise(values)
        plane = np.linalg.svd(z, full_matrices=False)[2][: min(3, z.shape[1] - 1)].T
        regimes = int(baseline.settings["multiple_pca_regimes"])
        mixture = fit_mixture(z @ plane, regimes, 3 * z.shape[1])
        memberships = mixture.memberships(z @ plane)
        parts = [weighted_components(z, weights) for weights in memberships.T]
        most = max(item.variances.size for _, item in parts)
        padded = [(0, most - item.variances.size) for _, item in parts]
        return {
            "centre": centre,
            "scale": scale,
            "plane": plane,
            **mixture._asdict(),
            "centres": np.array([mean for mean, _ in parts]),
            "loadings": np.array([np.pad(i.loadings, ((0, 0), by)) for (_, i), by in zip(parts, padded, strict=True)]),
            "variances": np.array([np.pad(item.variances, by) for (_, item), by in zip(parts, padded, strict=True)]),
            "rests": np.array([item.rest for _, item in parts]),
        }

    @classmethod
    def parts(cls, model: Model, window: Array) -> Array:
        """See `StatisticsChart`."""
        z = (window[-1] - model["centre"]) / model["scale"]
        memberships = memberships_of(model, z)
        regimes = zip(model["centres"], model["loadings"], model["variances"], model["rests"], strict=True)
        parts = [
            m * Components(loadings, loadings, *rest).relative_parts(z - mean)
            for m, (mean, loadings, *rest) in zip(memberships, regimes, strict=True)
        ]
        return np.asarray(sum(parts))

    def explain(self) -> tuple[str, dict[str, float]]:
        """See `ValueChart`, with the regime of the newest row."""
        text, shares = super().explain()
        memberships = memberships_of(self.model, (self._newest - self.model["centre"]) / self.model["scale"])
        regime = int(np.argmax(memberships))
        return f"{text}; regime {regime + 1} of {memberships.size} ({100 * memberships[regime]:.0f} %)", shares


def memberships_of(model: Model, z: Array) -> Array:
    """Memberships of a row of scaled deviations, shape (regimes,)."""
    mixture = Mixture(*(model[name] for name in Mixture._fields))
    return np.asarray(mixture.memberships((z @ model["plane"])[None])[0])


def weighted_components(z: Array, weights: Array) -> tuple[Array, Components]:
    """Mean and components of rows with weights, shapes (rows, signals) and (rows,)."""
    mean = weights @ z / weights.sum()
    off = z - mean
    return mean, Components.principal((off * weights[:, None]).T @ off / weights.sum())
