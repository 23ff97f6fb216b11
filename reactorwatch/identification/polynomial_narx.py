"""Polynomial NARX models from a record: products of past outputs and inputs, selected one by one.

    y[k] = sum of value * product of y[k-i] and u[k-j],    up to a degree, plus an offset.

Candidates are all products of the lagged signals. They are selected by forward orthogonal least squares: each step
takes the one whose part orthogonal to those before explains most of the output (Billings, Chen and Korenberg, Int. J.
Control 49 (1989) 2157). The linear terms come first: without them a record that excites little selects products
instead. A model with a good one-step prediction may diverge in simulation, so the number of terms is selected by
cross-validation of the simulation: a model of each half of the rows runs freely along the other half.

Products are formed of scaled signals, since those of signals far from zero are nearly dependent, and are expanded to
the signals' own units at the end.
"""

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.batch import least_squares
from reactorwatch.identification.linear_model import standard_deviations
from reactorwatch.identification.regressor import rows_of
from reactorwatch.identification.scaled_record import ScaledRecord
from reactorwatch.identification.simulation import PlanArrays, plan_run
from reactorwatch.identification.structure import Scaling, Structure, as_columns

DEGREE = 2
LARGEST_SIZE = 30
"""Number of terms beyond which no more are selected."""

DIVERGED = 1e6  # a scaled output beyond this, a million times its spread, has diverged

Product = tuple[int, ...]
"""Indices of the factors among the lagged signals, increasing; empty: the constant."""


@dataclass(frozen=True)
class PolynomialModel:
    """A fitted polynomial NARX model.

    Attributes:
        structure: lags and delay.
        scaling: scaling of the signals.
        products: terms for scaled signals, the constant first.
        values: coefficients of the terms, shape (terms,).
        covariance: shape (terms, terms), of the coefficients for scaled signals.
        rows: number of rows of the fit.
        simulates: whether it was fitted by simulation.
    """

    structure: Structure
    scaling: Scaling
    products: tuple[Product, ...]
    values: Array
    covariance: Array
    rows: int
    simulates: bool = False

    @property
    def parameter_count(self) -> int:
        """Number of parameters."""
        return self.values.size

    def predict(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """See `LinearModel.predict`."""
        u, y = self._scale(inputs, outputs)
        rows = rows_of(self.structure.without_offset(), u, y, time)
        predicted = np.full(y.shape, np.nan)
        predicted[rows.position, 0] = _multiply(rows.regressors, self.products) @ self.values
        return predicted * self.scaling.output_spreads[0] + self.scaling.output_centres[0]

    def simulate(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """See `LinearModel.simulate`."""
        u, y = self._scale(inputs, outputs)
        plan = plan_run(self.structure, u, y, time)
        run = run_products(self.values, factors_of(self.products), self.structure.orders, u, y[:, 0], plan.arrays)
        return (run * self.scaling.output_spreads[0] + self.scaling.output_centres[0])[:, None]

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Measured minus predicted or simulated, as in the fit, shape (rows, 1)."""
        run = self.simulate if self.simulates else self.predict
        return as_columns(outputs, "outputs", 1) - run(inputs, outputs, time)

    def expand(self) -> tuple[tuple[Product, ...], Array, Array]:
        """Terms in the signals' own units.

        Returns:
            The products, the constant first; their coefficients and the standard deviations, each of shape (products,).
        """
        s = self.structure
        centres = np.array(
            [*self.scaling.output_centres * s.output_lags, *self.scaling.input_centres * s.input_lags], dtype=np.float64
        )
        spreads = np.array(
            [*self.scaling.output_spreads * s.output_lags, *self.scaling.input_spreads * s.input_lags], dtype=np.float64
        )
        parts: list[dict[Product, float]] = []
        for product in self.products:
            part: dict[Product, float] = {(): self.scaling.output_spreads[0]}
            for factor in product:
                larger: dict[Product, float] = {}
                for known, weight in part.items():
                    with_factor = tuple(sorted((*known, factor)))
                    larger[with_factor] = larger.get(with_factor, 0.0) + weight / spreads[factor]
                    larger[known] = larger.get(known, 0.0) - weight * centres[factor] / spreads[factor]
                part = larger
            parts.append(part)
        own = sorted({product for part in parts for product in part}, key=lambda product: (len(product), product))
        matrix = np.array([[part.get(product, 0.0) for part in parts] for product in own])
        values = matrix @ self.values
        values[0] += self.scaling.output_centres[0]
        return tuple(own), values, standard_deviations(self.covariance, matrix)

    def _scale(self, inputs: ArrayLike, outputs: ArrayLike) -> tuple[Array, Array]:
        u, y = as_columns(inputs, "inputs", self.structure.inputs), as_columns(outputs, "outputs", 1)
        return np.ascontiguousarray(self.scaling.inputs(u)), np.ascontiguousarray(self.scaling.outputs(y))


def fit_narx(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
) -> PolynomialModel:
    """Fit a polynomial NARX model of one output.

    Args:
        structure: lags of output and inputs, with an offset.
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,), increasing, in any unit; None: gaps are not detected.

    Raises:
        InputError: an output that is constant, or fewer rows than candidates.
    """
    u, y = as_columns(inputs, "inputs", structure.inputs), as_columns(outputs, "outputs", 1)
    record = ScaledRecord.of(structure, u, y, time)
    rows = replace(record, structure=structure.without_offset()).enough_rows()
    candidates = candidate_products(structure)
    if rows.position.size < len(candidates):
        raise UnfitRecordError(
            f"the {len(candidates)} candidates for terms need as many complete rows, got {rows.position.size}; "
            "lower the order"
        )
    regressors, target = _multiply(rows.regressors, candidates), rows.outputs[:, 0]
    linear = sum(len(product) < DEGREE for product in candidates)
    order = [*range(linear), *_select(regressors, target, linear)]
    sizes = range(linear, min(len(order), LARGEST_SIZE) + 1)

    def fit(size: int, part: slice) -> PolynomialModel:
        solution = least_squares(regressors[part, order[:size]], target[part])
        products, values = tuple(candidates[i] for i in order[:size]), solution.parameters
        covariance = solution.noise_variance * solution.inverse
        return PolynomialModel(structure, record.scaling, products, values, covariance, target[part].size)

    def squares(size: int) -> float:
        """Sum of squares of the simulation errors of each half by a model of the other."""
        middle = target.size // 2
        row = int(rows.position[middle])
        try:
            first, second = fit(size, slice(middle)), fit(size, slice(middle, None))
        except InputError:  # half of the rows does not determine so many terms
            return np.inf
        times = None if time is None else np.asarray(time, dtype=np.float64)
        total = 0.0
        for model, part in ((first, slice(row, None)), (second, slice(row))):
            run = model.simulate(u[part], y[part], None if times is None else times[part])
            total += float(np.nansum((y[part] - run) ** 2))
        return total

    best = min(sizes, key=squares)
    return fit(best, slice(None))


def candidate_products(structure: Structure, degree: int = DEGREE) -> tuple[Product, ...]:
    """All products of the lagged signals up to the degree, the constant and the linear ones first."""
    signals = range(structure.parameters - int(structure.offset))
    return tuple(product for size in range(degree + 1) for product in combinations_with_replacement(signals, size))


def name_product(product: Product, structure: Structure, inputs: tuple[str, ...], output: str) -> str:
    """Name of a term by the lags in rows of its factors, such as `T1*u1` for T[k-1] u[k-1]."""
    names = []
    for factor in product:
        if factor < structure.output_lags:
            names.append(f"{output}{factor + 1}")
        else:
            lag, i = divmod(factor - structure.output_lags, structure.inputs)
            names.append(f"{inputs[i]}{structure.delay + lag}")
    return "*".join(names)


def _multiply(signals: Array, products: tuple[Product, ...]) -> Array:
    """Values of the products, shape (rows, products)."""
    return np.column_stack([np.prod(signals[:, list(product)], axis=1) for product in products])


def _select(regressors: Array, target: Array, first: int) -> list[int]:
    """Order in which forward orthogonal least squares takes the regressors from index `first` on."""
    base, _ = np.linalg.qr(regressors[:, :first])
    rest = regressors[:, first:] - base @ (base.T @ regressors[:, first:])
    error = target - base @ (base.T @ target)
    sizes = np.linalg.norm(regressors[:, first:], axis=0)
    taken: list[int] = []
    while len(taken) < min(LARGEST_SIZE - first, rest.shape[1]):
        norms = np.linalg.norm(rest, axis=0)
        usable = norms > 1e-6 * sizes  # less is a combination of those before
        usable[taken] = False
        if not usable.any():
            break
        explained = np.where(usable, (error @ rest) ** 2 / np.where(usable, norms, 1.0) ** 2, -1.0)
        best = int(np.argmax(explained))
        direction = rest[:, best] / norms[best]
        error = error - direction * (direction @ error)
        rest = rest - np.outer(direction, direction @ rest)
        taken.append(best)
    return [first + index for index in taken]


def factors_of(products: tuple[Product, ...]) -> NDArray[np.int64]:
    """Indices of the factors, shape (products, degree); -1 where there is none."""
    factors = np.full((len(products), max(map(len, products))), -1)
    for i, product in enumerate(products):
        factors[i, : len(product)] = product
    return factors


@jit
def run_products(
    values: NDArray[np.float64],
    factors: NDArray[np.int64],
    orders: tuple[int, int, int],
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    plan: PlanArrays,
) -> NDArray[np.float64]:
    """Simulate a polynomial of scaled signals.

    Args:
        values: coefficients, shape (terms,).
        factors: indices of each term's factors among the lagged signals, shape (terms, degree); -1: none.
        orders: see `Structure`.
        u: shape (rows, inputs).
        y: shape (rows,).
        plan: rows that are simulated, see `RunPlan.arrays`.

    Returns:
        Shape (rows,); NaN where it does not run, inf after it has diverged.
    """
    (output_lags, input_lags, delay), (starts, running) = orders, plan
    rows, inputs = u.shape
    run, own = np.full(rows, np.nan), np.zeros(rows)
    signals = np.empty(output_lags + input_lags * inputs)
    for k in range(rows):
        if not running[k]:
            continue
        if starts[k]:
            for back in range(1, output_lags + 1):
                own[k - back] = y[k - back]
        for lag in range(output_lags):
            signals[lag] = own[k - 1 - lag]
        for lag in range(input_lags):
            for i in range(inputs):
                signals[output_lags + lag * inputs + i] = u[k - delay - lag, i]
        total = 0.0
        for term in range(values.size):
            product = values[term]
            for position in range(factors.shape[1]):
                if factors[term, position] >= 0:
                    product *= signals[factors[term, position]]
            total += product
        own[k] = min(max(total, -DIVERGED), DIVERGED)
        run[k] = own[k] if abs(own[k]) < DIVERGED else np.inf
    return run
