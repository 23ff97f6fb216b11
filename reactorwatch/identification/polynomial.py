"""Polynomial models from a record: products of past outputs and inputs, selected one by one.

    y[k] = sum of value * product of y[k-i] and u[k-j],    up to a degree, plus an offset.

Products are formed of scaled signals, since those of signals far from zero are nearly dependent, and are expanded to
the signals' own units at the end. The linear terms come first: without them a record that excites little selects
products instead.

`fit_narx` fits the one-step error. Candidates are all products of the lagged signals, selected by forward orthogonal
least squares: each step takes the one whose part orthogonal to those before explains most of the output (Billings,
Chen and Korenberg, Int. J. Control 49 (1989) 2157). A model with a good one-step prediction may diverge in simulation,
so the number of terms is selected by cross-validation of the simulation: a model of each half of the rows runs freely
along the other half.

`fit_noe` fits the simulation error, of an output-error model whose past outputs are its own, by Marquardt's method.
Terms are added one by one (Piroddi and Spinelli, Int. J. Control 76 (2003) 1767): the sensitivities of the simulation
to all candidates at value 0 tell which ones may lower the error most; of the best few, each fitted with the terms so
far, the one with the smallest error is added. Their number is the one with the smallest error in cross-validation over
halves and quarters of the record. A model that diverges on rows left out of its fit ends the search: it would on other
records.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.data import PlanArrays, ScaledRecord, plan_run, rows_of
from reactorwatch.identification.least_squares import descend, least_squares, solution_at
from reactorwatch.identification.linear_model import standard_deviations
from reactorwatch.identification.structure import Orders, Scaling, Structure, as_columns

LARGEST_SIZE = 30  # number of terms of a NARX model beyond which no more are selected
Product = tuple[int, ...]
"""Indices of the factors among the lagged signals, increasing; empty: the constant."""


@dataclass(frozen=True)
class PolynomialModel:
    """A fitted polynomial model.

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
        """Number of coefficients."""
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
        signals = self.structure.orders, u, y[:, 0], plan.arrays
        run, _ = run_polynomial(self.values, factors_of(self.products), *signals, False)
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
        centres = [*self.scaling.output_centres * s.output_lags, *self.scaling.input_centres * s.input_lags]
        spreads = [*self.scaling.output_spreads * s.output_lags, *self.scaling.input_spreads * s.input_lags]
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
        return self.scaling.inputs(u), self.scaling.outputs(y)


def products_of(signals: int, degree: int) -> tuple[Product, ...]:
    """All products of some signals up to a degree, the constant first: those of a lower degree are the first."""
    return tuple(item for size in range(degree + 1) for item in combinations_with_replacement(range(signals), size))


def factors_of(products: tuple[Product, ...]) -> NDArray[np.int64]:
    """Indices of the factors, shape (products, degree); -1 where there is none."""
    factors = np.full((len(products), max(map(len, products))), -1)
    for i, product in enumerate(products):
        factors[i, : len(product)] = product
    return factors


def name_product(product: Product, structure: Structure, inputs: tuple[str, ...], output: str) -> str:
    """Name of a term by the lags in rows of its factors, such as `T1*u1` for T[k-1] u[k-1]."""
    names = []
    for factor in product:
        if factor < structure.output_lags:
            names.append(f"{output}{factor + 1}")
        else:
            lag, i = divmod(factor - structure.output_lags, structure.inputs)
            names.append(f"{inputs[i]}{structure.delays[i] + lag}")
    return "*".join(names)


def _multiply(signals: Array, products: tuple[Product, ...]) -> Array:
    """Values of the products, shape (rows, products)."""
    return np.column_stack([np.prod(signals[:, list(product)], axis=1) for product in products])


def fit_narx(
    structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None
) -> PolynomialModel:
    """Fit a polynomial NARX model of one output; arguments as for `linear.fit_linear`, a structure with an offset.

    Raises:
        InputError: an output that is constant, or fewer rows than candidates.
    """
    u, y = as_columns(inputs, "inputs", structure.inputs), as_columns(outputs, "outputs", 1)
    record = ScaledRecord.of(structure, u, y, time)
    rows = replace(record, structure=structure.without_offset()).enough_rows()
    candidates = products_of(structure.without_offset().parameters, 2)
    if rows.position.size < len(candidates):
        raise UnfitRecordError(
            f"the {len(candidates)} candidates for terms need as many complete rows, got {rows.position.size}; "
            "lower the order"
        )
    regressors, target = _multiply(rows.regressors, candidates), rows.outputs[:, 0]
    linear = sum(len(product) < 2 for product in candidates)
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
        total = 0.0
        for model, part in ((first, slice(row, None)), (second, slice(row))):
            run = model.simulate(u[part], y[part], None if time is None else np.asarray(time, dtype=np.float64)[part])
            total += float(np.nansum((y[part] - run) ** 2))
        return total

    return fit(min(sizes, key=squares), slice(None))


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


class _SimulationErrors:
    """Simulation errors of some rows of a record as a function of the coefficients; an `Objective`."""

    def __init__(self, products: tuple[Product, ...], record: ScaledRecord, rows: NDArray[np.int64]) -> None:
        self._factors, self._record, self._rows = factors_of(products), record, rows

    def run(self, theta: Array) -> tuple[Array, Array]:
        """Simulation of all rows, shape (rows,), and its gradient, shape (rows, terms)."""
        record = self._record
        signals = record.structure.orders, record.u, record.y[:, 0], record.plan.arrays
        return run_polynomial(theta, self._factors, *signals, True)

    def __call__(self, theta: Array) -> tuple[Array, Array] | None:
        """Errors and gradient; None if the simulation diverges."""
        run, gradient = self.run(theta)
        errors = (self._record.y[:, 0] - run)[self._rows]
        return (errors, gradient[self._rows]) if np.all(np.isfinite(errors)) else None


def fit_noe(
    structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None
) -> PolynomialModel:
    """Fit a polynomial output-error model of one output; arguments and errors as for `fit_narx`."""
    record = ScaledRecord.of(structure, inputs, outputs, time)
    rows, y = replace(record, structure=structure.without_offset()).enough_rows(), record.y[:, 0]
    compared = np.flatnonzero(record.plan.running & np.isfinite(y))
    for degree in (3, 2):
        candidates = products_of(structure.without_offset().parameters, degree)
        if 2 * len(candidates) <= compared.size:
            break
    else:
        raise UnfitRecordError(
            f"{len(candidates)} candidates for terms need twice as many rows of a simulation, got {compared.size}; "
            "lower the order"
        )

    def errors_of(products: tuple[Product, ...], chosen: NDArray[np.int64] = compared) -> _SimulationErrors:
        return _SimulationErrors(products, record, chosen)

    folds = [block for count in (2, 4) for block in np.array_split(compared, count)]

    def held_out_error(products: tuple[Product, ...], theta: Array) -> float:
        """Mean over the folds of the rms error where they are left out of the fit; inf if one run diverges."""
        sizes = []
        for fold in folds:
            fitted = errors_of(products, np.setdiff1d(compared, fold))
            run = fitted.run(descend(fitted, theta, 20)[0])[0][fold]
            if not np.all(np.isfinite(run)):
                return np.inf
            sizes.append(float(np.sqrt(np.mean((y[fold] - run) ** 2))))
        return float(np.mean(sizes))

    linear = tuple(product for product in candidates if len(product) < 2)
    arx = least_squares(np.column_stack([np.ones(rows.position.size), rows.regressors]), rows.outputs).parameters
    start = np.zeros(len(linear)) if errors_of(linear)(arx) is None else arx
    best = grown = linear, descend(errors_of(linear), start)[0]
    smallest = held_out_error(*grown)
    while len(grown[0]) < min(24, len(candidates)):
        larger = _grow(errors_of, candidates, *grown)
        if larger is None:
            break
        grown = larger
        error = held_out_error(*grown)
        if not np.isfinite(error):
            break
        if error < smallest:
            best, smallest = grown, error
    products, theta = best
    solution = solution_at(errors_of(products), theta)
    covariance = solution.noise_variance * solution.inverse
    return PolynomialModel(structure, record.scaling, products, theta, covariance, solution.rows, simulates=True)


def _grow(
    errors_of: Callable[..., _SimulationErrors],
    candidates: tuple[Product, ...],
    products: tuple[Product, ...],
    theta: Array,
) -> tuple[tuple[Product, ...], Array] | None:
    """Add the candidate that lowers the simulation error most; None if none can be fitted."""
    rest = tuple(product for product in candidates if product not in products)
    evaluated = errors_of((*products, *rest))(np.concatenate([theta, np.zeros(len(rest))]))
    if evaluated is None:
        return None
    errors, gradient = evaluated
    own, new = gradient[:, : theta.size], gradient[:, theta.size :]
    base, _ = np.linalg.qr(own)
    left, open_error = new - base @ (base.T @ new), errors - base @ (base.T @ errors)
    sizes = np.sum(left**2, axis=0)
    usable = sizes > 1e-9 * np.sum(new**2, axis=0)  # less is a combination of those before
    explained = np.where(usable, (open_error @ left) ** 2 / np.where(usable, sizes, 1.0), -1.0)
    fits = []
    for index in np.argsort(explained)[::-1][:5]:  # the best few of them are fitted
        if explained[index] > 0.0:
            larger = (*products, rest[index])
            values, squares = descend(errors_of(larger), np.append(theta, 0.0), 40)
            fits.append((squares, larger, values))
    return min(fits, key=lambda fit: fit[0])[1:] if fits else None


@jit
def run_polynomial(
    theta: NDArray[np.float64],
    factors: NDArray[np.int64],
    orders: Orders,
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    plan: PlanArrays,
    with_gradient: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Simulate a polynomial of scaled signals.

    Args:
        theta: coefficients, shape (terms,).
        factors: see `factors_of`.
        orders: see `Structure`.
        u: shape (rows, inputs).
        y: shape (rows,).
        plan: rows that are simulated, see `RunPlan.arrays`.
        with_gradient: whether the simulation is differentiated.

    Returns:
        The simulation, shape (rows,), NaN where it does not run and inf from where it has diverged to the next start,
        and its gradient by the coefficients, shape (rows, terms); without it shape (0, terms).
    """
    (output_lags, input_lags, delays), (starts, running) = orders, plan
    rows, inputs = u.shape
    size, degree = factors.shape
    run, own, diverged = np.full(rows, np.nan), np.zeros(rows), False
    gradient = np.zeros((rows if with_gradient else 0, size))
    signals, slopes = np.empty(output_lags + input_lags * inputs), np.empty(output_lags)
    for k in range(rows):
        if not running[k]:
            continue
        if starts[k]:
            diverged = False
            for back in range(1, output_lags + 1):
                own[k - back] = y[k - back]
                if with_gradient:
                    gradient[k - back] = 0.0
        if diverged:
            run[k] = np.inf
            continue
        for lag in range(output_lags):
            signals[lag] = own[k - 1 - lag]
        for lag in range(input_lags):
            for i in range(inputs):
                signals[output_lags + lag * inputs + i] = u[k - delays[i] - lag, i]
        total = 0.0
        for term in range(size):
            product = theta[term]
            for position in range(degree):
                if factors[term, position] >= 0:
                    product *= signals[factors[term, position]]
            total += product
        if not abs(total) < 1e6:  # a million times its spread
            diverged, run[k] = True, np.inf
            continue
        own[k] = run[k] = total
        if not with_gradient:
            continue
        slopes[:] = 0.0
        for term in range(size):
            product = 1.0
            for position in range(degree):
                factor = factors[term, position]
                if factor >= 0:
                    product *= signals[factor]
                if 0 <= factor < output_lags:
                    slope = theta[term]
                    for other in range(degree):
                        if other != position and factors[term, other] >= 0:
                            slope *= signals[factors[term, other]]
                    slopes[factor] += slope
            gradient[k, term] = product
        for lag in range(output_lags):
            for term in range(size):
                gradient[k, term] += slopes[lag] * gradient[k - 1 - lag, term]
    return run, gradient
