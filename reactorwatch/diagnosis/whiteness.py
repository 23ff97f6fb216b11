"""Whiteness test of the normalised innovations.

For each output, the autocorrelations over `LAGS` rows are tested together (Ljung & Box 1978, On a measure of lack of
fit in time series models, Biometrika 65), and so are the correlations with the changes of the inputs in the last `LAGS`
rows (Hosking 1980, The multivariate portmanteau statistic, J. American Statistical Association 75, has the sum of
squares that this is part of), without that in the same row, because a controller may have answered. The smaller p-value
counts, times the number of tests. Large values are clipped, so that a few outliers do not decide.

Detect residuals that resemble the error of an integrator's steps, or of the record's times. A record that was computed
with a coarser integrator differs from this simulation by that integrator's error: small, not white, and correlated with
the curvature of the trajectory. The error of one Euler step is, to leading order, h^2/2 d2x/dt2 (Hairer, Noersett &
Wanner 1993, Solving Ordinary Differential Equations I, II.1); an input that acts a little later or earlier than its
time stamp causes an error of the same shape. So the one-step residuals are correlated with it.
"""

from math import log

import casadi as ca
import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.batch import FilterResult
from reactorwatch.process.model import ProcessModel

LAGS = 20
CUT = 4.0
"""Standard deviations at which values are clipped."""

BURN_IN_ROWS = 20
WHITE = 6.0
"""Minus the decimal logarithm of the p-value beyond which innovations are not white; a search tests many hypotheses."""

DOUBTFUL = 3.0
"""Minus the decimal logarithm of the p-value beyond which the search looks for another explanation."""

LARGEST = 999.0


def minus_log10_p(w: Array, inputs: Array) -> Array:
    """Minus the decimal logarithm of the p-value that each output's innovations are white, shape (n_y,).

    Args:
        w: normalised innovations, shape (rows, n_y); NaN where not measured.
        inputs: shape (rows, n_u).
    """
    changes = np.diff(inputs, axis=0)[BURN_IN_ROWS - 1 :]
    result = []
    for column in w[BURN_IN_ROWS:].T:
        finite = np.isfinite(column)
        z = np.where(finite, np.clip(column, -CUT, CUT), 0.0)
        z = np.where(finite, z - z[finite].mean() if finite.any() else 0.0, 0.0)
        logs = [_log_sf(_squares(z, z, first=1))]
        logs += [_log_sf(_squares(z, change - change.mean(), first=1)) for change in changes.T if np.ptp(change) > 0.0]
        result.append(min(max(-(min(logs) + log(len(logs))) / log(10.0), 0.0), LARGEST))
    return np.array(result)


def _squares(z: Array, past: Array, first: int) -> float:
    """Sum of `LAGS` squared correlations of z with the past, each over its variance by chance."""
    n, total = z.size, 0.0
    scale = float(np.sum(z * z) * np.sum(past * past))
    if scale <= 0.0 or n <= 2 * LAGS:
        return 0.0
    for lag in range(first, first + LAGS):
        total += float(np.sum(z[lag:] * past[: n - lag])) ** 2 / scale * n * (n + 2) / (n - lag)
    return total


def _log_sf(statistic: float) -> float:
    """Logarithm of the upper tail of the chi-square distribution with `LAGS` degrees of freedom.

    For an even number of degrees it is a sum of Poisson probabilities (Abramowitz & Stegun 1964, 26.4.21).
    `scipy.stats` has it only as far as the tail itself does not underflow, and takes half a second to import.

    >>> round(_log_sf(31.4104328442309), 9) == round(log(0.05), 9)
    True
    """
    mean = 0.5 * statistic
    count = np.arange(LAGS // 2)
    return float(special.logsumexp(special.xlogy(count, mean) - special.gammaln(count + 1.0)) - mean)


LEAST_CORRELATION = 0.15
"""Minimum correlation in every output; by chance, in a thousand rows, it is some hundredths."""


def looks_like_integration(model: ProcessModel, run: Run, innovations: FilterResult) -> bool:
    """Return true if the residuals of every output are correlated with the error of a coarse step.

    Args:
        model: nominal model; its first outputs must be its states.
        run: the record.
        innovations: run of the nominal model's filter.
    """
    error = _shown_error(model, run, innovations.x)
    for residual, shape in zip(innovations.residual[1:].T, error.T, strict=True):
        finite = np.isfinite(residual) & np.isfinite(shape)
        if finite.sum() < 100 or np.ptp(shape[finite]) == 0.0:
            return False
        if abs(float(np.corrcoef(residual[finite], shape[finite])[0, 1])) < LEAST_CORRELATION:
            return False
    return True


def _shown_error(model: ProcessModel, run: Run, x: Array) -> Array:
    """Error of one Euler step from each row in the outputs, shape (rows - 1, n_y)."""
    state, u, p = model.arguments()
    t, h = ca.SX.sym("t"), ca.SX.sym("h")
    f = model.function()
    slope = f(state, u, p, t, t)[0]
    after = state + h * slope
    curved = after + 0.5 * h * (f(after, u, p, t, t)[0] - slope)
    error = f(curved, u, p, t, t)[1] - f(after, u, p, t, t)[1]
    function = CompiledFunction(ca.Function("error", [state, u, p, t, h], [error]), shared=[2])
    innovations = function.map(x[:-1], run.inputs[:-1], model.values(), run.time_min[:-1], np.diff(run.time_min))
    return innovations[0][:, :, 0]
