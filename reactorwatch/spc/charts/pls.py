"""Partial least squares: the signals as far as they predict the quality of the product, and the rest of them.

Wold (1966), Estimation of principal components and related models by iterative least squares; for charts Kresta,
MacGregor & Marlin (1991), Multivariate statistical monitoring of process operating performance, Can. J. Chem. Eng. 69.
The weights of a component are the direction of the scaled signals X that has the largest covariance with the quality
variables Y; its loadings are taken off both before the next one. Scores are t = R' x, and

    T2  = sum of t_a^2 / var(t_a),      unusually large moves of that on which the quality depends;
    SPE = |x - P t|^2,                  signals that no longer follow each other,

each divided by its mean. The quality is needed in the training only: later it may come late or not at all. The number
of components has the least error of prediction on held-out blocks.
"""

from typing import NamedTuple, Self

import numpy as np

from reactorwatch.arrays import Array, block_bounds
from reactorwatch.spc.charts.base import Setting, SignalSetting
from reactorwatch.spc.charts.pca import Components, standardise
from reactorwatch.spc.charts.value_chart import Model, StatisticsChart, ValueBaseline


class Projection(NamedTuple):
    """Components of signals that predict others.

    Attributes:
        rotations: R, shape (signals, components).
        loadings: P, same shape.
        of_quality: loadings of the quality variables, shape (quality variables, components).
    """

    rotations: Array
    loadings: Array
    of_quality: Array

    @classmethod
    def fit(cls, x: Array, y: Array, count: int) -> Self:
        """At most `count` components of centred values, shapes (rows, signals) and (rows, quality variables)."""
        weights, loadings, of_quality, first = [], [], [], 0.0
        for _ in range(count):
            directions, sizes, _ = np.linalg.svd(x.T @ y, full_matrices=False)
            if sizes[0] <= 1e-8 * first:  # X'Y is used up but for rounding
                break
            first = max(first, float(sizes[0]))
            scores = x @ directions[:, 0]
            length = float(scores @ scores)
            weights.append(directions[:, 0])
            loadings.append(x.T @ scores / length)
            of_quality.append(y.T @ scores / length)
            x, y = x - np.outer(scores, loadings[-1]), y - np.outer(scores, of_quality[-1])
        w, p = np.column_stack(weights), np.column_stack(loadings)
        return cls(w @ np.linalg.inv(p.T @ w), p, np.column_stack(of_quality))

    def first(self, count: int) -> Self:
        """The first components."""
        return type(self)(self.rotations[:, :count], self.loadings[:, :count], self.of_quality[:, :count])

    def predict(self, x: Array) -> Array:
        """Quality variables, shape (rows, quality variables)."""
        return x @ self.rotations @ self.of_quality.T


class Pls(StatisticsChart):
    """T2 and SPE of the signals that predict quality variables."""

    name = "pls"
    settings = (Setting("pls_weight", 0.1, 0.01, 1.0), SignalSetting("pls_quality", 20))
    labels = ("T2", "SPE")
    weight_key = "pls_weight"
    reason = "that predict the quality is unlike the training"
    fewest_signals = 3

    @classmethod
    def obstacle(cls, baseline: ValueBaseline) -> str:
        """See `ValueChart`."""
        count = len(baseline.names) - len(baseline.signals["pls_quality"])
        few = f"it needs two signals or more beside the quality variables, got {count}" if count < 2 else ""
        return super().obstacle(baseline) or few

    @classmethod
    def fit(cls, values: Array, baseline: ValueBaseline) -> Model:
        """See `StatisticsChart`."""
        is_quality = np.isin(baseline.names, baseline.signals["pls_quality"])
        centre, scale, z = standardise(values)
        x, y = z[:, ~is_quality], z[:, is_quality]
        fitted = Projection.fit(x, y, choose_components(x, y))
        scores = x @ fitted.rotations
        rest = np.sum((x - scores @ fitted.loadings.T) ** 2) / len(x)
        return {
            "centre": centre,
            "scale": scale,
            "is_quality": is_quality.astype(np.float64),
            "variances": np.var(scores, axis=0, ddof=1),
            "rest": np.array([max(rest, 1e-12)]),
            **fitted._asdict(),
        }

    @classmethod
    def parts(cls, model: Model, window: Array) -> Array:
        """See `StatisticsChart`; quality variables have none."""
        is_x = model["is_quality"] == 0.0
        off = ((window[-1] - model["centre"]) / model["scale"])[is_x]
        parts = np.zeros((2, is_x.size))
        parts[:, is_x] = Components.of(model).relative_parts(off)
        return parts

    def explain(self) -> tuple[str, dict[str, float]]:
        """See `ValueChart`, with the predicted quality of the newest row."""
        text, shares = super().explain()
        model, is_y = self.model, self.model["is_quality"] > 0.0
        off = ((self._newest - model["centre"]) / model["scale"])[~is_y]
        predicted = model["centre"][is_y] + model["scale"][is_y] * (model["of_quality"] @ (off @ model["rotations"]))
        names = [name for name, here in zip(self.names, is_y.tolist(), strict=True) if here]
        quality = ", ".join(f"{name} {value:.4g}" for name, value in zip(names, predicted.tolist(), strict=True))
        return f"{text}; predicted quality: {quality}", shares


def choose_components(x: Array, y: Array) -> int:
    """Number of components with the least squared error of prediction on held-out blocks; at most 8."""
    most = min(8, x.shape[1] - 1)  # one less than signals, so that something is left for SPE
    errors = np.zeros(most)
    for first, end in block_bounds(len(x)):
        others = np.r_[0:first, end : len(x)]
        fitted = Projection.fit(x[others], y[others], most)
        errors += [np.sum((fitted.first(a).predict(x[first:end]) - y[first:end]) ** 2) for a in range(1, most + 1)]
    return int(np.argmin(errors)) + 1
