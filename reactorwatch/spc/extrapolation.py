"""Error of a model at other points of operation, by the rows of a training that each part of it did not see.

A plant is linear only roughly, so a model errs at points of operation that its rows do not have, and the error lasts
as long as the plant stays there. How far a point is from the rows is Mahalanobis's distance D of the averaged inputs,
in mean squares a signal; a sensor with a fault does not change it. The variance of the lasting error grows with it,

    b^2 = g1 D + g2 D^2,

in units of the variance of a residual: g1 for coefficients that are not quite known, g2 for a plant that bends. A
residual has the variance 1 + b^2, but an average with the weight w, whose own variance is w / (2 - w), has 1 + b^2 (2 -
w) / w times that. Both gains are learned from averages in blocks of the training, predicted by a fit to the others,
whose distance is that from the others.
"""

from math import sqrt
from typing import NamedTuple

import msgspec
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.spc.averages import ewma, independent_rows
from reactorwatch.stored_state import Storable

WEIGHT = 1.0 / 20.0
"""Weight of the newest row in averages of the inputs: the longest model looks 20 rows back."""

BLOCKS = 10
"""Blocks of a training, each predicted by a fit to the others."""

MOST_LAGS = 1000
"""Rows beyond which averages are not taken to be correlated: a hundred memories of the usual chart."""

GAINS = np.append(0.0, np.geomspace(0.0005, 5.0, 33))
"""Values of g1 and g2 that are weighed; with the largest, an error as large as the noise is everywhere."""


class Extrapolation(Storable, msgspec.Struct, frozen=True):
    """Variance of residuals by the distance of a point of operation from those of the training.

    Attributes:
        centre: mean of the averaged inputs in the training, shape (inputs,).
        root: matrix that makes them independent with unit variance, shape (inputs, inputs).
        gains: g1 and g2.
        weight: weight of the newest row in the averages of charts.
    """

    centre: Array
    root: Array
    gains: tuple[float, float]
    weight: float

    def sds(self, averages: Array) -> tuple[float, float]:
        """Standard deviations of a residual and of averages at averaged inputs, in units of those of noise."""
        distance = float(np.mean(np.square(self.root @ (averages - self.centre))))
        variance = self.gains[0] * distance + self.gains[1] * distance * distance
        return sqrt(1.0 + variance), sqrt(1.0 + variance * _rows(self.weight))


class FittedExtrapolation(NamedTuple):
    """An extrapolation as fitted.

    Attributes:
        extrapolation: the extrapolation.
        sds: standard deviations of the residuals by it, of the rows of the training, each held out, shape (n,).
        sds_of_averages: the same of averages.
        averages: averaged inputs at the last row, shape (inputs,).
    """

    extrapolation: Extrapolation
    sds: Array
    sds_of_averages: Array
    averages: Array

    @property
    def usual_sds(self) -> tuple[float, ...]:
        """Standard deviations of averages at equally likely distances, for what all charts would see."""
        return tuple(np.quantile(self.sds_of_averages, (0.1, 0.3, 0.5, 0.7, 0.9)).tolist())

    @property
    def memory_shares(self) -> Array:
        """Share of a residual that charts with a memory take, shape (n,)."""
        return np.asarray(self.sds / self.sds_of_averages)


def fit_extrapolation(averages: Array, e: Array, weight: float) -> FittedExtrapolation | None:
    """Fit the variance of residuals by the distance of the inputs; None where the rows are too few for that.

    The gains are means over their posterior, given flat priors of their logarithms. Of several outputs, whose errors
    are alike at a point of operation, that combination counts in which they grow most.

    Args:
        averages: averaged inputs, shape (n, inputs).
        e: prewhitened residuals of held-out rows, shape (n, outputs); NaN where there is none.
        weight: weight of the newest row in the averages of charts.
    """
    e = e[:, np.isfinite(e).any(axis=0)]
    distances = np.empty(len(averages))
    for block in np.array_split(np.arange(len(averages)), BLOCKS):
        centre, root = _standardise(np.delete(averages, block, axis=0))
        distances[block] = np.mean(np.square((averages[block] - centre) @ root.T), axis=1)
    known = np.isfinite(e).all(axis=1)
    if not e.shape[1] or np.count_nonzero(known) < BLOCKS * e.shape[1]:
        return None
    white = np.nan_to_num(e) @ _standardise(e[known])[1].T
    smoothed = ewma(white, weight) * sqrt(_rows(weight))
    near = np.minimum(distances, np.quantile(distances, 0.98))  # one far block is not to choose the combination
    _, directions = np.linalg.eigh((smoothed.T * near) @ smoothed)
    combined = smoothed @ directions[:, -1:]
    squares = np.square(combined[known, 0])
    share = independent_rows(combined, min(len(combined) // 10, MOST_LAGS)) / len(combined)
    gains, powers = np.meshgrid(GAINS, (1.0, 2.0))
    variances = 1.0 + _rows(weight) * gains[..., None] * distances[known] ** powers[..., None]
    fits = -0.5 * share * np.sum(np.log(variances) + squares / variances, axis=2)
    posterior = np.exp(fits - fits.max())
    of_each = np.sum(posterior * gains, axis=1) / posterior.sum()
    centre, root = _standardise(averages)
    found = Extrapolation(centre, root, (float(of_each[0]), float(of_each[1])), weight)
    lasting = of_each[0] * distances + of_each[1] * distances**2
    return FittedExtrapolation(found, np.sqrt(1.0 + lasting), np.sqrt(1.0 + _rows(weight) * lasting), averages[-1])


def _rows(weight: float) -> float:
    """Number of independent rows whose mean has the variance of an average."""
    return (2.0 - weight) / weight


def average_inputs(inputs: Array) -> Array:
    """Exponential averages of inputs, shape (n, inputs); a missing value is that of the row before, or the first."""
    known = np.isfinite(inputs)
    at = np.where(known, np.arange(len(inputs))[:, None], np.argmax(known, axis=0))
    filled = np.nan_to_num(np.take_along_axis(inputs, np.maximum.accumulate(at, axis=0), axis=0))
    return np.asarray(filled[0] + ewma(filled - filled[0], WEIGHT))


def _standardise(values: Array) -> tuple[Array, Array]:
    """Mean of values, and the matrix that makes them independent with unit variance; 0 for those that do not vary."""
    centre, spreads = values.mean(axis=0), values.std(axis=0)
    varies = spreads > 1e-9 * np.maximum(np.abs(centre), 1e-300)
    scaled = np.where(varies, (values - centre) / np.where(varies, spreads, 1.0), 0.0)
    sizes, directions = np.linalg.eigh(scaled.T @ scaled / len(scaled))
    used = np.where(sizes > 1e-6, 1.0 / np.sqrt(np.maximum(sizes, 1e-6)), 0.0)
    root = (directions * used).T / np.where(varies, spreads, 1.0)
    return centre, np.ascontiguousarray(root * varies)
