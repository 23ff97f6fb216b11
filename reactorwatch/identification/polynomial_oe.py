"""Polynomial output-error models from a record: products of the model's own past outputs and of past inputs.

    y[k] = w[k] + e[k],    w[k] = sum of value * product of w[k-i] and u[k-j], up to a degree, plus an offset.

The coefficients minimise the simulation error, by the search of `descent`; a polynomial fitted by its one-step
error (`polynomial_narx`) is as good there, and often diverges in simulation. Terms are added one by one to the linear
ones (Piroddi and Spinelli, Int. J. Control 76 (2003) 1767): the sensitivities of the simulation to all candidates at
value 0 tell which ones may lower the error most; of the best few, each fitted with the terms so far, the one with the
smallest error is added. Their number is the one with the smallest error in cross-validation over halves and quarters
of the record. A model that diverges on rows left out of its fit ends the search: it would on other records.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import UnfitRecordError
from reactorwatch.identification.batch import least_squares
from reactorwatch.identification.descent import descend, solution_at
from reactorwatch.identification.polynomial_narx import (
    DIVERGED,
    PolynomialModel,
    Product,
    candidate_products,
    factors_of,
)
from reactorwatch.identification.scaled_record import ScaledRecord
from reactorwatch.identification.simulation import PlanArrays
from reactorwatch.identification.structure import Structure

DEGREES = (3, 2)
"""Degree of the polynomials, and the one for so many signals that there would be more candidates than rows."""

LARGEST_SIZE = 24
"""Number of terms beyond which no more are added."""

TRIED = 5
"""Number of candidates that are fitted before one is added."""

FOLDS = (2, 4)
"""Numbers of blocks into which the record is cut for cross-validation."""

ITERATIONS, ROUGH_ITERATIONS = 40, 20
"""Largest numbers of iterations of a descent, and of one whose model is only compared."""

_DEPENDENT = 1e-9  # share of a sensitivity's square that is not a combination of those before


class _Objective:
    """Simulation errors of some rows and their gradient."""

    def __init__(self, products: tuple[Product, ...], record: ScaledRecord, rows: NDArray[np.int64]) -> None:
        self._factors, self._record, self._rows = factors_of(products), record, rows

    def run(self, theta: Array) -> tuple[Array, Array]:
        """Simulation of all rows, shape (rows,), and its gradient, shape (rows, terms)."""
        record = self._record
        return run_with_gradient(
            theta, self._factors, record.structure.orders, record.u, record.y[:, 0], record.plan.arrays
        )

    def __call__(self, theta: Array) -> tuple[Array, Array]:
        """Errors, shape (compared rows,), and the gradient, shape (compared rows, terms)."""
        run, gradient = self.run(theta)
        return (self._record.y[:, 0] - run)[self._rows], gradient[self._rows]

    def admits(self, theta: Array) -> bool:
        """True if the simulation does not diverge."""
        return bool(np.all(np.isfinite(self.run(theta)[0][self._rows])))


def fit_noe(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
) -> PolynomialModel:
    """Fit a polynomial output-error model of one output.

    Args:
        structure: lags of output and inputs, with an offset.
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,), increasing, in any unit; None: gaps are not detected.

    Raises:
        InputError: an output that is constant, or fewer rows than candidates.
    """
    record = ScaledRecord.of(structure, inputs, outputs, time)
    record = replace(record, u=np.ascontiguousarray(record.u), y=np.ascontiguousarray(record.y))
    rows = replace(record, structure=structure.without_offset()).enough_rows()
    compared = np.flatnonzero(record.plan.running & np.isfinite(record.y[:, 0]))
    candidates = _choose_candidates(structure, compared.size)

    def objective(products: tuple[Product, ...], chosen: NDArray[np.int64] = compared) -> _Objective:
        return _Objective(products, record, chosen)

    linear = tuple(product for product in candidates if len(product) < 2)
    start = np.zeros(len(linear))
    arx = least_squares(np.column_stack([np.ones(rows.position.size), rows.regressors]), rows.outputs).parameters
    if objective(linear).admits(arx):
        start = arx
    folds = [block for count in FOLDS for block in np.array_split(compared, count)]
    best = grown = linear, descend(objective(linear), start)[0]
    smallest = _held_out_error(objective, *grown, folds, compared, record.y[:, 0])
    while len(grown[0]) < min(LARGEST_SIZE, len(candidates)):
        larger = _grow(objective, candidates, *grown)
        if larger is None:
            break
        grown = larger
        error = _held_out_error(objective, *grown, folds, compared, record.y[:, 0])
        if not np.isfinite(error):
            break
        if error < smallest:
            best, smallest = grown, error
    products, theta = best
    solution = solution_at(objective(products), theta)
    covariance = solution.noise_variance * solution.inverse
    return PolynomialModel(structure, record.scaling, products, theta, covariance, solution.rows, simulates=True)


def _choose_candidates(structure: Structure, rows: int) -> tuple[Product, ...]:
    """Products of the highest degree for which there are twice as many rows.

    Raises:
        InputError: there are too few rows for any degree.
    """
    for degree in DEGREES:
        candidates = candidate_products(structure, degree)
        if 2 * len(candidates) <= rows:
            return candidates
    raise UnfitRecordError(
        f"{len(candidates)} candidates for terms need twice as many rows of a simulation, got {rows}; lower the order"
    )


def _grow(
    objective: Callable[..., _Objective], candidates: tuple[Product, ...], products: tuple[Product, ...], theta: Array
) -> tuple[tuple[Product, ...], Array] | None:
    """Add the candidate that lowers the simulation error most; None if none can be fitted."""
    rest = tuple(product for product in candidates if product not in products)
    errors, gradient = objective((*products, *rest))(np.concatenate([theta, np.zeros(len(rest))]))
    own, new = gradient[:, : theta.size], gradient[:, theta.size :]
    base, _ = np.linalg.qr(own)
    left, open_error = new - base @ (base.T @ new), errors - base @ (base.T @ errors)
    sizes = np.sum(left**2, axis=0)
    usable = sizes > _DEPENDENT * np.sum(new**2, axis=0)
    explained = np.where(usable, (open_error @ left) ** 2 / np.where(usable, sizes, 1.0), -1.0)
    fits = []
    for index in np.argsort(explained)[::-1][:TRIED]:
        if explained[index] > 0.0:
            larger = (*products, rest[index])
            values, squares = descend(objective(larger), np.append(theta, 0.0), ITERATIONS)
            fits.append((squares, larger, values))
    return min(fits, key=lambda fit: fit[0])[1:] if fits else None


def _held_out_error(
    objective: Callable[..., _Objective],
    products: tuple[Product, ...],
    theta: Array,
    folds: list[NDArray[np.int64]],
    compared: NDArray[np.int64],
    y: Array,
) -> float:
    """Mean over the folds of the root mean square error where they are left out of the fit; inf if one run diverges."""
    errors = []
    for fold in folds:
        fitted = objective(products, np.setdiff1d(compared, fold))
        run = fitted.run(descend(fitted, theta, ROUGH_ITERATIONS)[0])[0][fold]
        if not np.all(np.isfinite(run)):
            return np.inf
        errors.append(float(np.sqrt(np.mean((y[fold] - run) ** 2))))
    return float(np.mean(errors))


@jit
def run_with_gradient(
    theta: NDArray[np.float64],
    factors: NDArray[np.int64],
    orders: tuple[int, int, int],
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    plan: PlanArrays,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Simulate a polynomial of scaled signals, with derivatives.

    Args:
        theta: coefficients, shape (terms,).
        factors: see `polynomial_narx.run_products`.
        orders: see `Structure`.
        u: shape (rows, inputs).
        y: shape (rows,).
        plan: rows that are simulated, see `RunPlan.arrays`.

    Returns:
        The simulation, shape (rows,), NaN where it does not run and inf from where it has diverged, and its gradient,
        shape (rows, terms).
    """
    (output_lags, input_lags, delay), (starts, running) = orders, plan
    rows, inputs = u.shape
    size, degree = factors.shape
    run, own = np.full(rows, np.nan), np.zeros(rows)
    gradient = np.zeros((rows, size))
    signals, slopes = np.empty(output_lags + input_lags * inputs), np.empty(output_lags)
    for k in range(rows):
        if not running[k]:
            continue
        if starts[k]:
            for back in range(1, output_lags + 1):
                own[k - back] = y[k - back]
                gradient[k - back] = 0.0
        for lag in range(output_lags):
            signals[lag] = own[k - 1 - lag]
            slopes[lag] = 0.0
        for lag in range(input_lags):
            for i in range(inputs):
                signals[output_lags + lag * inputs + i] = u[k - delay - lag, i]
        total = 0.0
        for term in range(size):
            product = 1.0
            for position in range(degree):
                if factors[term, position] >= 0:
                    product *= signals[factors[term, position]]
            gradient[k, term] = product
            total += theta[term] * product
            for position in range(degree):
                lag = factors[term, position]
                if 0 <= lag < output_lags:
                    slope = theta[term]
                    for other in range(degree):
                        if other != position and factors[term, other] >= 0:
                            slope *= signals[factors[term, other]]
                    slopes[lag] += slope
        if not abs(total) < DIVERGED:
            run[k:] = np.inf
            break
        own[k] = total
        run[k] = total
        for lag in range(output_lags):
            for term in range(size):
                gradient[k, term] += slopes[lag] * gradient[k - 1 - lag, term]
    return run, gradient
