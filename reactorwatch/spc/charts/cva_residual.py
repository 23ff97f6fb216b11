"""Canonical variates of past and future rows: the average of what the past of the plant says beside its state.

Larimore (1990), Canonical variate analysis in identification, filtering, and adaptive control, Proc. CDC 29; Russell,
Chiang & Braatz (2000), Fault detection in industrial processes using canonical variate analysis and dynamic principal
component analysis, Chemometrics Intell. Lab. Syst. 51. The past of a row is the row and the two before it, made white;
the directions that correlate most with the next three rows are the state, and

    Tr2 = squared length of the rest of the past,

divided by its dimension. The rest are relations that sound rows keep: signals that hardly vary when others are given,
controllers that move valves by what they measure. Each row breaks them a little more after a small fault, in either
direction, and the average with a long memory sees it. A fit to n rows with q values of the past makes Tr2 of new rows
larger by n / (n - q - 2) (the mean of Hotelling's F); held-out rows, which are judged by fewer, are corrected by that.
"""

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.spc.charts.base import Setting
from reactorwatch.spc.charts.pca import EXPLAINED, standardise
from reactorwatch.spc.charts.value_chart import Model, StatisticsChart, ValueBaseline

ROWS = 3
"""Rows of the past and of the future."""


class CvaResidual(StatisticsChart):
    """The average of Tr2."""

    name = "cva_residual"
    settings = (Setting("cva_residual_weight", 0.02, 0.005, 1.0),)
    labels = ("Tr2",)
    rows_before = ROWS - 1
    weight_key = "cva_residual_weight"
    reason = "breaks the relations of sound rows"

    @classmethod
    def fit(cls, values: Array, baseline: ValueBaseline) -> Model:
        """See `StatisticsChart`."""
        centre, scale, x = standardise(values)
        rows = len(x) - 2 * ROWS + 1
        past, future = (
            np.concatenate([x[first + i : first + i + rows] for i in range(ROWS)], axis=1) for first in (0, ROWS)
        )
        past, future = past - past.mean(axis=0), future - future.mean(axis=0)
        whitening, of_future = inverse_root(past.T @ past / (rows - 1)), inverse_root(future.T @ future / (rows - 1))
        left, correlations, _ = np.linalg.svd(whitening @ (past.T @ future / (rows - 1)) @ of_future.T)
        shares = np.cumsum(correlations**2) / np.sum(correlations**2)
        states = min(int(np.searchsorted(shares, EXPLAINED) + 1), len(left) - 1)
        rest = np.ascontiguousarray(left[:, states:].T @ whitening)
        return {"centre": centre, "scale": scale, "rest": rest}

    @classmethod
    def statistics(cls, model: Model, window: Array) -> Array:
        """See `StatisticsChart`."""
        rest = model["rest"] @ ((window - model["centre"]) / model["scale"]).ravel()
        return np.array([rest @ rest / rest.size])

    @classmethod
    def parts(cls, model: Model, window: Array) -> Array:
        """See `StatisticsChart`."""
        off = ((window - model["centre"]) / model["scale"]).ravel()
        products = off * ((model["rest"] @ off) @ model["rest"]) / len(model["rest"])
        return np.asarray(products.reshape(window.shape).sum(axis=0)[None])

    @classmethod
    def shrinkage(cls, model: Model, held_out: int, rows: int) -> float:
        """See `StatisticsChart`."""
        size = model["rest"].shape[1] + 2
        return float((1.0 - size / held_out) / (1.0 - size / rows))

    @classmethod
    def obstacle(cls, baseline: ValueBaseline) -> str:
        """See `ValueChart`."""
        values, names = baseline.values, baseline.names
        needed = 3 * ROWS * len(names)  # three rows for each value of the past
        if (why := super().obstacle(baseline)) or len(values) >= needed:
            return why
        return f"the training has {len(values)} complete rows, {needed} are needed for {len(names)} signals"


def inverse_root(covariance: Array) -> Array:
    """Matrix that makes values of a covariance white, shape (directions, values), without directions of no variance."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-10 * values[-1]
    return np.asarray((vectors[:, kept] / np.sqrt(values[kept])).T)
