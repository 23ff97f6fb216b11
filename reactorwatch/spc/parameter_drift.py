"""Design of the chart on the parameters of an adaptive model from a training record.

A model y = phi' theta + e that is learned by least squares with the forgetting factor f obeys, with w = 1 - f and an
average over the rows in memory on both sides,

    mean(phi phi') (theta_k - theta) = z_k,       z_k = (1 - w) z_(k-1) + w phi_k e_k,

so its error is H^-1 z with H = E[phi phi'], and z is a moving average of the scores phi e. Where they are correlated
for less long than the memory lasts, z has the variance w / (2 - w) Omega, with Omega the sum of their covariances over
all lags, and the parameters

    w / (2 - w) V,      V = H^-1 Omega H^-1

(Ljung & Gunnarsson 1990, Adaptation and tracking in system identification - a survey, Automatica 26). The textbook's V,
s^2 H^-1, is that of residuals that are white and independent of the regressors. Those of a linear model of a plant that
is not linear are neither (White 1980, Econometrica 48; Newey & West 1987, Econometrica 55).

The reference is such a model stopped after N rows; its variance is larger by r = (1 + f^N) / (1 - f^N). So the
difference of the two has the covariance

    C = w / (2 - w) (1 + r) V.

The reference's error is constant. The limit allows for that, see `run_length/parameters.py`.

Omega is learned by cosines, Omega = (c_1 c_1' + ... + c_K c_K') / K, with c_j the scores' coefficient of the j-th
cosine over the record and K = 0.4 rows^(2/3) (Lazarus, Lewis, Stock & Watson 2018, HAR inference: recommendations for
practice, J. Business & Economic Statistics 36). It errs as a covariance from K independent vectors does, so Hotelling's
F is its limit (Sun 2013, A heteroskedasticity and autocorrelation robust F test using an orthonormal series variance
estimator, Econometrics J. 16). The weights of Newey & West have no such limit; with an F of as many degrees of freedom
as their variance has they were no better (docs/charts.md).
"""

from collections.abc import Sequence
from math import floor, sqrt

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Array
from reactorwatch.spc.charts.parameters import ParameterT2
from reactorwatch.spc.run_length.arguments import check_range
from reactorwatch.spc.run_length.mewma import SMALLEST_WEIGHT_WITHOUT_SHIFT
from reactorwatch.spc.run_length.parameters import parameter_limit

LEAST_EXCITATION = 1e-10
"""A direction whose mean square is below this share of the largest is not excited, regressors brought to unit size."""

SMALLEST_SD = 1e-9
"""Smallest standard deviation of the residual, in scaled units: without any noise rounding would count as drift."""

ROWS_A_DIRECTION = 10
"""Smallest memory of the adaptive model, in rows a direction; with less, H is not the average in memory."""

VECTORS_A_DIRECTION = 2
"""Smallest number of cosines a direction for Omega."""


def adaptive_weight(forgetting: float) -> float:
    """Weight of the newest row in an adaptive model with this forgetting factor."""
    return max(1.0 - forgetting, SMALLEST_WEIGHT_WITHOUT_SHIFT)


def learn(
    regressors: ArrayLike,
    residuals: ArrayLike,
    forgetting: float,
    reference_rows: int,
    arl0: float,
    names: Sequence[str],
    past_outputs: int,
) -> ParameterT2:
    """Design the chart of a model from a training record.

    Args:
        regressors: shape (rows, p), by time, in scaled units: outputs of the order of 1.
        residuals: residuals of any model with these regressors, in scaled units, shape (rows,); the part that the
            regressors still explain is removed.
        forgetting: forgetting factor f of the adaptive model, and of the reference in training, in [0.9, 0.9999].
        reference_rows: N, number of training rows of the reference.
        arl0: rows to a false alarm, averaged over the references of such trainings.
        names: names of the p parameters.
        past_outputs: number of leading regressors that are past outputs; the others are inputs and offset.

    Raises:
        InputError: an argument out of its range or of a wrong shape, a value that is not finite, or a training too
            short, without any excitation, or with all excitation of a parameter in a few rows.
    """
    phi, e = np.asarray(regressors, dtype=np.float64), np.asarray(residuals, dtype=np.float64)
    if phi.ndim != 2 or phi.shape[1] != len(names) or e.shape != phi.shape[:1]:
        raise InputError(
            f"regressors must have {len(names)} columns and as many rows as there are residuals, "
            f"got {phi.shape} and {e.shape}"
        )
    if not (np.all(np.isfinite(phi)) and np.all(np.isfinite(e))):
        raise InputError("regressors and residuals must be finite numbers; leave out the rows that are not")
    check_range("past_outputs", past_outputs, 0, len(names))
    check_range("reference_rows", reference_rows, 1, float("inf"))
    rows = len(phi)
    white = _whitening(phi)
    m, vectors = len(white), floor(0.4 * rows ** (2.0 / 3.0))
    if m == 0:
        raise InputError("regressors must vary or have an offset, all of them are 0")
    if vectors < VECTORS_A_DIRECTION * m:
        least = (VECTORS_A_DIRECTION * m / 0.4) ** 1.5
        raise InputError(f"training must have at least {least:.0f} rows for {m} parameters, got {rows}")
    check_range(
        "forgetting", forgetting, max(0.9, 1.0 - 1.0 / (ROWS_A_DIRECTION * m)), 1.0 - SMALLEST_WEIGHT_WITHOUT_SHIFT
    )
    weight = adaptive_weight(forgetting)

    z = phi @ white.T
    e = (e - z @ (z.T @ e) / rows) * sqrt(rows / (rows - m))
    omega = _long_run_covariance(z * e[:, None], vectors) + SMALLEST_SD**2 * np.eye(m)
    memory = forgetting**reference_rows
    share = (1.0 + memory) / (1.0 - memory)
    # In coordinates that make the regressors white, V is Omega.
    values = np.linalg.eigvalsh(omega)
    if values[0] <= rows * np.finfo(np.float64).eps * values[-1]:
        raise InputError(
            "training must have moves of the inputs in more rows, parameters depend on a few rows of it only"
        )
    root = np.linalg.inv(np.linalg.cholesky(omega)) @ (z.T @ phi) / rows
    limit = parameter_limit(arl0, m, weight, vectors, share)
    inputs = np.zeros((0, len(names)))
    if past_outputs < len(names):
        of_inputs = _whitening(phi[:, past_outputs:])
        inputs = np.hstack([np.zeros((len(of_inputs), past_outputs)), of_inputs])
    return ParameterT2(names, root / sqrt(weight / (2.0 - weight) * (1.0 + share)), limit, inputs, forgetting)


def _whitening(rows: Array) -> Array:
    """Whitening matrix of rows, without removing a mean, shape (excited directions, columns)."""
    size = np.sqrt(np.mean(rows * rows, axis=0))
    unit = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    scaled = rows * unit
    values, directions = np.linalg.eigh(scaled.T @ scaled / len(rows))
    kept = values > LEAST_EXCITATION * max(values[-1], LEAST_EXCITATION)
    return np.asarray((directions[:, kept] / np.sqrt(values[kept])).T * unit)


def _long_run_covariance(scores: Array, vectors: int) -> Array:
    """Sum of the scores' covariances over all lags, shape (m, m), from their slowest cosines."""
    rows = len(scores)
    phase = np.pi / rows * (np.arange(rows) + 0.5)
    coefficients = sqrt(2.0 / rows) * np.cos(np.outer(np.arange(1, vectors + 1), phase)) @ scores
    return np.asarray(coefficients.T @ coefficients / vectors)
