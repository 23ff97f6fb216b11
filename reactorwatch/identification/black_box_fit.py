"""Fit of a state map to a training.

1. The parameters minimise the errors of simulations (Gauss-Newton), approached through constant gains from 1, an ARX
   model, to 0, a simulation: from far away a simulation diverges. A gain above 0 is kept only where it is likelier by
   `MARGIN`: a plant at rest is described as well by white noise of the process and no dynamics at all, and that model
   is certain of itself and wrong at the next set point.
2. A normal prior keeps products small that the training does not excite. So degree and terms need not be selected: the
   posterior covariance says which are known.
3. The variances of process and measurements maximise the likelihood of the filter (`log_likelihood`).
4. The number of lags is that of the largest likelihood less half the effective parameters times the logarithm of the
   rows (Schwarz, Ann. Statist. 6 (1978) 461). Then one degree more is tried by Akaike's criterion, with a margin.
5. With little noise what remains is the error of the polynomial, which is larger where it was not fitted. So rows of
   the training are predicted by fits to the others (`held_out_residuals`).
"""

from dataclasses import dataclass, replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array, block_bounds
from reactorwatch.errors import InputError
from reactorwatch.identification.black_box_filter import BlackBoxFilter
from reactorwatch.identification.black_box_model import (
    NEXT,
    START,
    BlackBoxModel,
    RowArrays,
    Shape,
    lagged_inputs,
    log_likelihood,
    prediction_errors,
)

MOST_PARAMETERS = 90  # of all outputs; the filter's work grows with their square
ROWS_A_PARAMETER = 4  # least number of measured values for each parameter
MARGIN = 10.0  # of log-likelihood that a larger gain or degree must bring, and half of it noise of the process


@dataclass(frozen=True)
class Rows:
    """Scaled rows of a training.

    Attributes:
        y: outputs, shape (rows, outputs); NaN where missing.
        u: lagged inputs, shape (rows, inputs lags).
        kinds: kinds of the rows, see `START`.
        smallest: smallest variance of each output's measurements.
    """

    y: Array
    u: Array
    kinds: NDArray[np.int64]
    smallest: Array

    @property
    def arrays(self) -> RowArrays:
        """Outputs, inputs and kinds, for kernels."""
        return self.y, self.u, self.kinds


@dataclass
class _Fit:
    """Parameters of a gain, their covariance, the variances of the errors, and the log-likelihood of these."""

    gain: float
    theta: Array
    covariance: Array
    variances: Array
    likelihood: float


def largest_shapes(outputs: int, inputs: int, rows: int, delay: int = 1) -> list[Shape]:
    """For each number of lags the shape of the largest degree that is small enough; empty if there is none."""
    most = min(MOST_PARAMETERS, rows * outputs // ROWS_A_PARAMETER)
    shapes = []
    for lags in range(1, 4):
        degrees = [degree for degree in (1, 2, 3) if Shape(outputs, inputs, lags, degree, delay).parameters <= most]
        if degrees:
            shapes.append(Shape(outputs, inputs, lags, degrees[-1], delay))
    return shapes


def fit_black_box(
    inputs: Array, outputs: Array, follows: NDArray[np.bool_], smallest_sd: Array, delay: int = 1
) -> BlackBoxModel:
    """Fit a state map to a training.

    Args:
        inputs: shape (rows, inputs); NaN where missing. There may be no input.
        outputs: shape (rows, outputs); NaN where missing.
        follows: True where a row is one period after the row before, shape (rows,).
        smallest_sd: smallest standard deviation of each output's measurements, in its unit; above 0.
        delay: delay of the inputs in rows.

    Raises:
        InputError: there are too few rows or too many signals.
    """
    centres, spreads = _scaling(outputs, inputs)
    count = outputs.shape[1]
    y, u = (outputs - centres[:count]) / spreads[:count], (inputs - centres[count:]) / spreads[count:]
    smallest = np.square(np.maximum(smallest_sd / spreads[:count], 1e-6))  # less is rounding
    complete = int(np.isfinite(outputs).all(axis=1).sum())

    def fit(shape: Shape) -> tuple[float, float, BlackBoxModel] | None:
        """Log-likelihood of a shape, its effective parameters and its model; None if the rows are too few."""
        lagged = lagged_inputs(shape, u)
        rows = Rows(y, lagged, row_kinds(shape, y, lagged, follows), smallest)
        measured = int(np.isfinite(y[rows.kinds == NEXT]).all(axis=1).sum())
        if measured * count < ROWS_A_PARAMETER * shape.parameters:
            return None
        fitted = _fit_shape(shape, rows)
        r, q, likelihood = _fit_variances(shape, rows, fitted)
        effective = shape.parameters - float(np.sum(np.diag(fitted.covariance) / prior_variances(shape)))
        share = effective / count
        inflation = measured / max(measured - share, 0.1 * measured)
        variances, scaling = (r * inflation, q * inflation), (centres, spreads)
        parameters = fitted.theta, fitted.covariance
        model = BlackBoxModel.of(shape, measured, share, fitted.gain, scaling, variances, *parameters)
        return likelihood, effective, model

    best = max(
        (item for shape in largest_shapes(count, inputs.shape[1], complete, delay) if (item := fit(shape)) is not None),
        key=lambda item: item[0] - 0.5 * item[1] * np.log(item[2].rows),
        default=None,
    )
    if best is not None:
        finer = replace(best[2].shape, degree=4)  # with little noise a cubic is visibly wrong
        other = fit(finer) if finer.parameters <= MOST_PARAMETERS else None
        if other is not None and other[0] - other[1] > best[0] - best[1] + MARGIN:
            best = other
    if best is None:
        raise InputError(
            f"a model of {count} outputs and {inputs.shape[1]} inputs needs at least "
            f"{ROWS_A_PARAMETER * (1 + count + inputs.shape[1])} complete rows in succession and at most "
            f"{MOST_PARAMETERS} parameters, got {len(y)} rows"
        )
    return best[2]


OUTERMOST = 0.01
"""Share of the rows with the least values of an output, and of those with the largest, that are held out: as far beyond
the others as the values of a watch that is a hundred times as long are beyond those of the training, if tails are
exponential."""


def held_out_residuals(
    model: BlackBoxModel, rows: tuple[Array, Array, NDArray[np.bool_]], evaluated: Array, smallest_sd: Array
) -> tuple[Array, Array]:
    """Normalised residuals of rows of the training, predicted by fits to the others: blocks, and outermost values.

    The larger counts.

    Args:
        model: the fitted model.
        rows: inputs, outputs and flags of rows that follow the row before, as they were fitted.
        evaluated: outputs that are predicted, shape (rows, outputs).
        smallest_sd: smallest standard deviation of each output's measurements, in its unit.

    Returns:
        Residuals, and their standard deviations, both of shape (rows, outputs); NaN where there is no prediction.
    """
    shape, (inputs, outputs, follows) = model.shape, rows
    centres, spreads, count = np.array(model.centres), np.array(model.spreads), model.outputs
    y, u = (outputs - centres[:count]) / spreads[:count], (inputs - centres[count:]) / spreads[count:]
    smallest = np.square(np.maximum(smallest_sd / spreads[:count], 1e-6))
    lagged, variances = lagged_inputs(shape, u), (np.array(model.r), np.array(model.q))
    z, sds = np.full(outputs.shape, np.nan), np.full(outputs.shape, np.nan)
    for held in _held_out_rows(y):
        others, joined = np.where(held[:, None], np.nan, y), follows & (held == np.roll(held, 1))
        kinds = row_kinds(shape, others, lagged, joined)
        fitted = _gauss_newton(shape, Rows(others, lagged, kinds, smallest), model.theta, model.gain, 20)
        if fitted is None:  # the others do not determine the plant
            continue
        scaling, parameters = (centres, spreads), (fitted.theta, fitted.covariance)
        other = BlackBoxModel.of(shape, model.rows, model.effective, model.gain, scaling, variances, *parameters)
        row_filter = BlackBoxFilter(other)
        row_filter.learning = False
        for k in range(len(y)):
            if not follows[k]:
                row_filter.restart()
            predicted = row_filter.update(inputs[k].tolist(), evaluated[k].tolist(), [inf] * count)
            if predicted is None or not held[k]:
                continue
            found, found_sds = (evaluated[k] - predicted.prediction) / predicted.sd, np.array(predicted.sd)
            larger = ~(np.abs(found) <= np.abs(z[k]))
            z[k, larger], sds[k, larger] = found[larger], found_sds[larger]
    return z, sds


def _held_out_rows(y: Array) -> list[NDArray[np.bool_]]:
    """Flags of the rows that are held out at a time: blocks, and the outermost values, beyond which others will be."""
    rows, found = np.arange(len(y)), []
    for first, end in block_bounds(len(y)):
        found.append((first <= rows) & (rows < end))
    low, high = np.nanquantile(y, (OUTERMOST, 1.0 - OUTERMOST), axis=0)
    return [*found, *(y < low).T, *(y > high).T]


def row_kinds(shape: Shape, y: Array, lagged: Array, follows: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Kinds of the rows: a state needs `lags` complete rows in succession, and its next row known inputs."""
    complete = np.asarray(np.isfinite(y).all(axis=1))
    known = np.asarray(np.isfinite(lagged).all(axis=1))
    kinds = np.zeros(len(y), dtype=np.int64)
    in_row, last_gap = 0, 0
    for k in range(len(y)):
        if not follows[k]:
            in_row, last_gap = 0, k
        in_row = in_row + 1 if complete[k] else 0
        has_inputs = known[k] and k - last_gap >= shape.past - 1
        before = k > 0 and follows[k] and kinds[k - 1] != 0
        if before and known[k - 1]:
            kinds[k] = NEXT
        elif in_row >= shape.lags and has_inputs:
            kinds[k] = START
    return kinds


def prior_variances(shape: Shape) -> Array:
    """Prior variances of the parameters, shape (parameters,)."""
    degrees = np.count_nonzero(shape.products() >= 0, axis=1)
    # Standard deviations by degree, of scaled signals.
    return np.tile(np.square((1.0, 1.0, 0.17, 0.07, 0.03))[degrees], shape.outputs)


def _scaling(outputs: Array, inputs: Array) -> tuple[Array, Array]:
    """Centres and spreads of the outputs, then of the inputs; spread 1 for a constant one."""
    columns = np.column_stack([outputs, inputs])
    centres, spreads = np.nanmean(columns, axis=0), np.nanstd(columns, axis=0)
    return centres, np.where(spreads > 1e-12 * np.maximum(1.0, np.abs(centres)), spreads, 1.0)


def _fit_shape(shape: Shape, rows: Rows) -> _Fit:
    """Fit by rising degree: the fit of a degree starts that of the next."""
    best: _Fit | None = None
    gains: tuple[float, ...] = (1.0, 0.6, 0.3, 0.1, 0.03, 0.0)
    for degree in range(1, shape.degree + 1):
        part = Shape(shape.outputs, shape.inputs, shape.lags, degree, shape.delay)
        start = np.zeros((part.outputs, part.terms))
        if best is not None:
            start[:, : best.theta.shape[1]] = best.theta
            gains = (best.gain, 0.0) if best.gain > 0.0 else (0.0,)
        best = _fit_gains(part, rows, start, gains)
    assert best is not None
    return best


def _fit_gains(shape: Shape, rows: Rows, theta: Array, gains: tuple[float, ...]) -> _Fit:
    best: _Fit | None = None
    for gain in gains:
        fitted = _gauss_newton(shape, rows, theta, gain, 20 if gain == gains[-1] else 5)
        if fitted is None:
            continue
        theta = fitted.theta
        if best is None or fitted.likelihood > best.likelihood - MARGIN:
            best = fitted
    if best is None:  # even the start diverges: that of the gain 1 with no dynamics cannot
        best = _gauss_newton(shape, rows, np.zeros_like(theta), 1.0, 5)
    assert best is not None
    return best


def _gauss_newton(shape: Shape, rows: Rows, theta: Array, gain: float, iterations: int) -> _Fit | None:
    """Minimise the errors of a gain; None if the start diverges."""
    products, size = shape.products(), shape.parameters
    precision = 1.0 / prior_variances(shape)
    errors, gram, slope = np.empty_like(rows.y), np.empty((size, size)), np.empty(size)
    nothing = np.empty((0, 0))

    def run(candidate: Array, weights: Array, equations: Array) -> bool:
        return prediction_errors(
            candidate, products, shape.states, rows.arrays, gain, weights, errors, equations, slope
        )

    def cost(candidate: Array, weights: Array) -> float:
        squares = float(np.nansum(errors**2 * weights))
        return squares + float(np.sum(candidate.ravel() ** 2 * precision))

    ones = np.ones(shape.outputs)
    if not run(theta, ones, nothing):
        return None
    variances, damping = _variances(errors, rows.smallest), 1e-6
    for _ in range(iterations):
        weights = 1.0 / variances
        run(theta, weights, gram)
        before = after = cost(theta, weights)
        information, pull = gram + np.diag(precision), slope - theta.ravel() * precision
        for _ in range(8):
            damped = information + damping * np.diag(np.diag(information))
            candidate = theta + np.linalg.solve(damped, pull).reshape(theta.shape)
            if run(candidate, weights, nothing) and cost(candidate, weights) < before:
                theta, after, damping = candidate, cost(candidate, weights), 0.1 * damping
                break
            damping = max(10.0 * damping, 1e-4)
        run(theta, weights, nothing)
        variances = _variances(errors, rows.smallest)
        if before - after <= 1e-4 * before:
            break
    run(theta, 1.0 / variances, gram)
    covariance = _inverse(gram + np.diag(precision))
    counts = np.count_nonzero(np.isfinite(errors), axis=0)
    likelihood = -0.5 * float(np.sum(counts * np.log(variances)))
    return _Fit(gain, theta, covariance, variances, likelihood)


def _inverse(information: Array) -> Array:
    """Inverse of a symmetric positive definite matrix, positive definite in spite of rounding."""
    scale = 1.0 / np.sqrt(np.diag(information))
    values, directions = np.linalg.eigh(scale[:, None] * information * scale)
    root = (
        scale[:, None] * directions / np.sqrt(np.maximum(values, len(values) * np.finfo(np.float64).eps * values[-1]))
    )
    return np.asarray(root @ root.T)


def _variances(errors: Array, smallest: Array) -> Array:
    return np.asarray(np.maximum(np.nanmean(errors**2, axis=0), smallest))


def _fit_variances(shape: Shape, rows: Rows, fitted: _Fit) -> tuple[Array, Array, float]:
    """Variances of measurements and process that maximise the likelihood, and that, by a compass search."""
    products, count = shape.products(), shape.outputs
    least = 1e-8 * fitted.variances  # of the process: as good as none
    bounds = np.log(np.concatenate([rows.smallest, least]))

    def likelihood(logs: Array) -> float:
        r, q = np.exp(logs[:count]), np.exp(logs[count:])
        return log_likelihood(fitted.theta, products, shape.states, rows.arrays, r, q)

    without = np.maximum(np.log(np.concatenate([fitted.variances, least])), bounds)
    share = max(fitted.gain, 0.03)
    logs = np.log(np.concatenate([fitted.variances * max(1.0 - share, 0.05), fitted.variances * share**2]))
    logs = np.maximum(logs, bounds)
    value, value_without, step = likelihood(logs), likelihood(without), 1.0
    while step > 0.1:
        improved = False
        for i in range(2 * count):
            for move in (step, -step):
                candidate = logs.copy()
                candidate[i] = max(candidate[i] + move, bounds[i])
                if (other := likelihood(candidate)) > value:
                    logs, value, improved = candidate, other, True
                    break
        if not improved:
            step *= 0.5
    if value_without > value - 0.5 * MARGIN:
        logs, value = without, value_without
    return np.exp(logs[:count]), np.exp(logs[count:]), value
