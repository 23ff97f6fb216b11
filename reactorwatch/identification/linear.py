"""Fit of linear models to a record: ARX by least squares, the others by the smallest prediction error.

With measurement noise on the output, an ARX model is biased: it treats the noise as a disturbance of the plant. The
output-error model minimises its simulation error,

    yhat[k] = a1 yhat[k-1] + ... + b1 u[k-d] + ... + c,      sum (y[k] - yhat[k])^2 -> min,

which is unbiased for any noise that is independent of the input (Ljung, System Identification, 2nd ed., sections 4.2
and 8.4). ARMAX and Box-Jenkins models (`linear_model`) describe the disturbance too, and minimise their one-step errors
e; for normal e this is maximum likelihood (section 7.4). The search is `least_squares.descend`, with all poles and the
zeros of the disturbance inside the unit circle. To keep the zeros there loses nothing: the mirror image of a zero gives
the same spectrum. The parameters' covariance is s2 (G'G)^-1, which supposes white residuals: where the whiteness test
fails it is too small.

The sum has local minima (section 10.5: none for white inputs, but these inputs are steps), so there are several starts.
Of an output-error model: the ARX model, the instrumental variable estimate, the Steiglitz-McBride iterate (IEEE Trans.
AC 10 (1965) 461), and the best model of one order less with a pole at zero, so that a higher order never fits worse. Of
a model with a disturbance: least squares, the output-error model, the disturbance by two regressions as of Hannan and
Rissanen (Biometrika 69 (1982) 81), and a model of one order less.

The instrumental variable estimate has no bias from measurement noise, in closed form. Least squares on noisy lagged
outputs is biased: the noise is in the regressors too. The method replaces them, on one side of the equations, by a
simulation of the last model, which is free of noise: Z'X p = Z'y with Z the regressors of that run (Soderstrom and
Stoica, System Identification, 1989, chapter 8; the iteration of Young, Automatica 6 (1970) 271). Z = Q S, so
Q'X p = Q'y is solved, whose condition is not squared.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.data import ScaledRecord, rows_of
from reactorwatch.identification.least_squares import (
    ITERATIONS,
    LeastSquares,
    best_descent,
    least_squares,
    solution_at,
)
from reactorwatch.identification.linear_model import Kind, LinearModel, PredictionErrors, simulate
from reactorwatch.identification.structure import Scaling, Structure

ROUGH_ITERATIONS = 20  # of a descent that only leads to a start


def fit_linear(
    kind: Kind, structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None
) -> LinearModel:
    """Fit a linear model of one output.

    Rows with a missing value, or just after a gap in time, are excluded.

    Args:
        kind: kind of the model; without inputs an ARMAX model is an ARMA model.
        structure: terms of the plant, with an offset but for ARX; the disturbance has as many lags as the output.
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,), increasing, in any unit; None: gaps are not detected.

    Raises:
        InputError: too few rows, an output that is constant, rows that don't determine the parameters, or a
            Box-Jenkins model without inputs.
    """
    if kind == "bj" and structure.inputs == 0:
        raise InputError("a Box-Jenkins model needs an input, got none; without inputs it is an ARMAX model: use armax")
    record = ScaledRecord.of(structure, inputs, outputs, time)
    rows = record.enough_rows()
    if kind == "arx":
        solution = least_squares(rows.regressors, rows.outputs)
    else:
        theta, errors = _minimise(kind, record)
        solution = solution_at(errors, theta)
    return unscale(kind, structure, record.scaling, solution)


def unscale(kind: Kind, structure: Structure, scaling: Scaling, solution: LeastSquares) -> LinearModel:
    """Make a model in the signals' own units from a solution for scaled signals.

    Args:
        kind: kind of the model.
        structure: terms of the plant.
        scaling: scaling of the signals.
        solution: solution for all parameters.
    """
    plant, size, variance = structure.parameters, solution.parameters.size, solution.noise_variance
    matrix, shift = np.eye(size), np.zeros(size)
    matrix[:plant, :plant], shift[:plant] = scaling.unscaling(structure)
    known = np.isfinite(variance) and np.all(np.isfinite(solution.inverse))
    covariance = variance * matrix @ solution.inverse @ matrix.T if known else np.full((size, size), np.inf)
    noise_sd = float(np.sqrt(variance)) * scaling.output_spreads[0]
    parameters = matrix @ solution.parameters + shift
    return LinearModel(kind, structure, parameters, covariance, noise_sd, solution.condition, solution.rows)


def _errors(kind: Kind, record: ScaledRecord) -> PredictionErrors:
    return PredictionErrors(kind, record.structure, record.u, record.y, record.plan)


def _minimise(kind: Kind, record: ScaledRecord, iterations: int = ITERATIONS) -> tuple[Array, PredictionErrors]:
    """Best parameters, shape (parameters,), and the errors as a function of them."""
    structure, lags, errors = record.structure, record.structure.output_lags, _errors(kind, record)
    usable = int(errors.compared.sum())
    if usable < errors.size:
        run = "simulation" if kind == "oe" else "prediction"
        raise UnfitRecordError(
            f"{errors.size} parameters need at least {errors.size} rows of a {run}, got {usable} of {len(record.y)}"
        )
    if kind == "oe":
        return best_descent(errors, _plant_starts(record, iterations), iterations), errors
    starts = _armax_starts(record)
    if structure.inputs:
        plant, simulation = _minimise("oe", record, ITERATIONS if kind == "bj" else ROUGH_ITERATIONS)
        starts.append(np.concatenate([plant, -plant[:lags]]))
    if kind == "bj":
        best = best_descent(_errors("armax", record), starts, ROUGH_ITERATIONS)
        v = np.full(record.y.shape, np.nan)
        v[simulation.compared, 0] = simulation(plant)[0]
        alone = replace(record, structure=Structure(lags, lags, inputs=0), u=np.empty((len(v), 0)), y=v)
        noise, _ = _minimise("armax", alone)
        starts = [
            np.concatenate([plant, np.zeros(2 * lags)]),
            np.concatenate([plant, noise[:lags], noise[-lags:]]),
            np.concatenate([best[: structure.parameters], best[:lags], best[-lags:]]),
        ]
    return best_descent(errors, starts, iterations), errors


def _plant_starts(record: ScaledRecord, iterations: int) -> list[Array]:
    """The ARX model, the instrumental variable and Steiglitz-McBride estimates, and the best model of an order less."""
    structure, arx = record.structure, _stable_arx(record)
    starts = [arx, instrumental_variable(record), _steiglitz_mcbride(record, arx)]
    if structure.output_lags > 1 and structure.input_lags > 1:
        lags = structure.output_lags - 1, structure.input_lags - 1
        lower = Structure(*lags, structure.delay, structure.inputs, offset=structure.offset)
        starts.append(_pad_order(lower, _minimise("oe", replace(record, structure=lower), iterations)[0]))
    return starts


def _armax_starts(record: ScaledRecord) -> list[Array]:
    """Least squares, the regressions of Hannan and Rissanen, and the best of them with one order less."""
    structure, lags, rows = record.structure, record.structure.output_lags, record.rows()
    starts = [np.concatenate([_stable_arx(record), np.zeros(lags)])]
    past = rows_of(Structure(lags, lags), _innovations(record), record.y, record.time)
    both, of_plant, of_noise = np.intersect1d(rows.position, past.position, return_indices=True)
    if both.size > structure.parameters + lags:
        wide = np.concatenate([rows.regressors[of_plant], past.regressors[of_noise][:, lags : 2 * lags]], axis=1)
        theta = np.linalg.lstsq(wide, rows.outputs[of_plant, 0])[0]
        plant = stabilize(structure, theta[: structure.parameters])
        starts.append(np.concatenate([plant, -mirror_poles(-theta[structure.parameters :])]))
    if lags > 1:
        lower = Structure.of_order(lags - 1, structure.delay, structure.inputs)
        smaller = replace(record, structure=lower)
        best = best_descent(_errors("armax", smaller), _armax_starts(smaller), ROUGH_ITERATIONS)
        noise = best[lower.parameters :]
        starts.append(np.concatenate([_pad_order(lower, best[: lower.parameters]), noise, [0.0]]))
    return starts


def _innovations(record: ScaledRecord) -> Array:
    """Residuals of an ARX model of a high order, shape (rows, 1); NaN where it has none."""
    structure = record.structure
    # three times the order of the model, as far as there are four rows for a parameter
    order = min(3 * structure.output_lags + 4, len(record.y) // (4 * (structure.inputs + 1)))
    long = Structure(max(order, 1), max(order, 1), structure.delay, structure.inputs)
    rows = replace(record, structure=long).rows()
    e = np.full(record.y.shape, np.nan)
    theta = np.linalg.lstsq(rows.regressors, rows.outputs)[0]
    e[rows.position] = rows.outputs - rows.regressors @ theta
    return e


def _stable_arx(record: ScaledRecord) -> Array:
    """Parameters of the ARX model of a record of one output, its poles mirrored into the unit circle."""
    rows = record.rows()
    return stabilize(record.structure, least_squares(rows.regressors, rows.outputs).parameters)


def instrumental_variable(record: ScaledRecord) -> Array:
    """Instrumental variable estimate, shape (parameters,), its poles mirrored into the unit circle.

    Raises:
        InputError: too few rows, or rows that don't determine the parameters.
    """
    structure, rows, theta = record.structure, record.rows(), _stable_arx(record)
    for _ in range(5):
        run = simulate(structure, theta, record.u, record.y, record.plan)
        # A simulation starts from measured rows.
        instruments = replace(record, y=np.where(np.isfinite(run), run, record.y)).rows()
        both = np.intersect1d(rows.position, instruments.position, assume_unique=True)
        x, y = (part[np.searchsorted(rows.position, both)] for part in (rows.regressors, rows.outputs[:, 0]))
        q, _ = np.linalg.qr(instruments.regressors[np.searchsorted(instruments.position, both)])
        equations = q.T @ x
        if np.linalg.cond(equations) > 1e12:
            break
        theta = stabilize(structure, np.asarray(np.linalg.solve(equations, q.T @ y)))
    return theta


def _steiglitz_mcbride(record: ScaledRecord, theta: Array) -> Array:
    """Steiglitz-McBride iteration: ARX of signals filtered by 1 / (1 - a1 q^-1 - ...) of the model before."""
    structure, lags = record.structure, record.structure.output_lags
    for _ in range(10):
        signals = np.concatenate([record.u, record.y, np.ones_like(record.y)], axis=1)
        filtered = _filter(np.ascontiguousarray(theta[:lags]), signals)
        rows = rows_of(structure, filtered[:, :-2], filtered[:, -2], record.time)
        regressors = rows.regressors.copy()
        if structure.offset:
            regressors[:, -1] = filtered[rows.position, -1]
        try:
            solution = least_squares(regressors, rows.outputs)
        except InputError:  # the filtered signals do not determine the parameters: take the last iterate
            break
        theta = stabilize(structure, solution.parameters)
    return theta


@jit
def _filter(a: NDArray[np.float64], signals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Filter each column by 1 / (1 - a1 q^-1 - ...), from rest after a missing value."""
    filtered = np.empty_like(signals)
    for i in range(signals.shape[1]):
        for k in range(signals.shape[0]):
            total = signals[k, i]
            for lag in range(min(a.size, k)):
                before = filtered[k - 1 - lag, i]
                if before != before:
                    break
                total += a[lag] * before
            filtered[k, i] = total
    return filtered


def _pad_order(structure: Structure, parameters: Array) -> Array:
    """Parameters of the same model with one lag more of output and inputs, which adds a pole at zero."""
    lags = structure.output_lags
    middle = lags + structure.input_lags * structure.inputs
    zeros = np.zeros(structure.inputs)
    return np.concatenate([parameters[:lags], [0.0], parameters[lags:middle], zeros, parameters[middle:]])


def stabilize(structure: Structure, parameters: Array) -> Array:
    """Mirror poles on or outside the unit circle into it, with a small margin."""
    lags = structure.output_lags
    inside = parameters.copy()
    inside[:lags] = mirror_poles(parameters[:lags])
    return inside


def mirror_poles(a: Array) -> Array:
    """Coefficients of y[k] = a1 y[k-1] + ... with the poles on or outside the unit circle mirrored into it."""
    poles = np.roots([1.0, *-a])
    outside = np.abs(poles) >= 1.0
    if not np.any(outside):
        return a
    poles[outside] = 0.98 / np.conj(poles[outside])
    return np.asarray(-np.real(np.poly(poles))[1:])
