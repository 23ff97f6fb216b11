"""Prewhitening: an autoregression of a residual, learned from the training, and its innovations for the charts.

Run lengths hold for independent values. The residuals of a plant are correlated: the model is incomplete, and noise is
coloured. A CUSUM with a false alarm every 465 samples has one every 118 if neighbours are correlated by 0.25 (Johnson &
Bagshaw 1974, The effect of serial correlation on the performance of CUSUM tests, Technometrics 16). So an
autoregression of the residual on its own past is learned from the training, and the charts take its innovations, in
units of their standard deviation (Alwan & Roberts 1988, Time-series modeling for statistical process control, J.
Business & Economic Statistics 6):

    e[k] = (z[k] - c - a1 z[k-1] - ... - ap z[k-p]) / sigma.

A lasting shift of z by d appears in e as d (1 - a1 - ... - ap) / sigma: a residual that wanders by itself masks small
faults. Mean, standard deviation and coefficients come from a finite training, and charts with a long memory are
sensitive to their errors; the size of these is stored beside them, and limits are widened by it (see
`false_alarm_budget`).
"""

from collections.abc import Sequence
from math import inf, nan, sqrt
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.spc.averages import ewma

LARGEST_ORDER = 6
"""Largest number of coefficients: a filter has room for so many past values."""


class Prewhitening(msgspec.Struct, frozen=True):
    """An autoregression of a residual, learned from its training.

    Attributes:
        constant: c, in the units of z.
        coefficients: a1, ..., ap.
        sd: sigma, in the units of z.
        rows: number of training rows.
        sd_variance: variance of the relative error of sigma.
        passed_variance: variance of the relative error of 1 - a1 - ... - ap; it acts on a chart
            with a long memory like one of sigma.
    """

    constant: float
    coefficients: tuple[float, ...]
    sd: float
    rows: int
    sd_variance: float
    passed_variance: float

    @property
    def shift_gain(self) -> float:
        """Gain of a lasting shift in e, 1 - a1 - ... - ap."""
        return 1.0 - sum(self.coefficients)


def learn(z: Array, smallest_sd: float, largest_order: int = LARGEST_ORDER) -> Prewhitening:
    """Learn the autoregression of a residual, its order by Akaike's criterion, at least 1.

    The order is never 0: even an insignificant correlation changes the run length of a chart with a long memory, and a
    learned coefficient carries its uncertainty.

    Args:
        z: shape (n,), by time; NaN where missing or to be ignored.
        smallest_sd: lower bound of sigma.
        largest_order: largest number of coefficients; 0: the residual is no noise, and only its size is learned.
    """
    known = int(np.count_nonzero(np.isfinite(z)))
    largest = min(largest_order, known // 10 - 1)
    fits = []
    if largest >= 1:
        lagged = np.column_stack([z[largest - lag : z.size - lag] for lag in range(largest + 1)])
        rows = lagged[np.all(np.isfinite(lagged), axis=1)]
        fits = [_fit(rows, order, smallest_sd) for order in range(1, largest + 1) if len(rows) > 3 * (order + 1)]
    if not fits:
        return _constant(z[np.isfinite(z)], smallest_sd)
    return min(fits, key=lambda fit: fit.rows * np.log(fit.sd) + len(fit.coefficients))


def _constant(z: Array, smallest_sd: float) -> Prewhitening:
    sd = float(np.std(z, ddof=1)) if z.size > 1 else 0.0
    return Prewhitening(
        float(np.mean(z)) if z.size else 0.0, (), max(sd, smallest_sd), z.size, 1.0 / (2.0 * max(z.size, 1)), 0.0
    )


def _fit(rows: Array, order: int, smallest_sd: float) -> Prewhitening:
    target, past = rows[:, 0], rows[:, 1 : order + 1]
    centre = past.mean(axis=0)
    centred = past - centre
    gram = centred.T @ centred
    # Regularisation makes the coefficients of a constant residual 0.
    gram[np.diag_indices(order)] += 1e-9 * np.trace(gram) / order + max(smallest_sd**2, 1e-30)
    a = np.linalg.solve(gram, centred.T @ (target - target.mean()))
    if a.sum() > 0.98:  # nearer to 1 the residual is a random walk, and no shift would be detected
        a *= 0.98 / a.sum()
    error = target - target.mean() - centred @ a
    freedom = len(rows) - order - 1
    variance = float(error @ error) / freedom
    sd = max(variance**0.5 * _worst_block(error), smallest_sd)
    passed = 1.0 - float(a.sum())
    of_sum = variance * float(np.sum(np.linalg.inv(gram)))
    return Prewhitening(
        constant=float(target.mean() - centre @ a),
        coefficients=tuple(a.tolist()),
        sd=sd,
        rows=len(rows),
        sd_variance=_sd_variance(error, freedom),
        passed_variance=of_sum / passed**2,
    )


def _worst_block(error: Array) -> float:
    """Ratio of the worst block's standard deviation to the overall one; 1 if the blocks do not differ.

    The fit of a linear model of a nonlinear plant varies with the operating point, and the worst fit makes the false
    alarms. So where blocks of rows differ significantly, sigma is that of the worst of them (the largest of twenty).
    """
    rows = 50  # of a block: its standard deviation is known to a tenth
    blocks = error[: error.size // rows * rows].reshape(-1, rows)
    size = np.sqrt(np.mean(error**2)) if error.size else 0.0
    if len(blocks) < 8 or size <= 0.0:
        return 1.0
    sizes = np.sqrt(np.mean(blocks**2, axis=1)) / size
    fourth = float(np.mean(error**4)) / size**4
    expected_variance = max(fourth - 1.0, 1.0) / (4.0 * rows)
    if float(np.var(sizes, ddof=1)) <= 2.0 * expected_variance:
        return 1.0
    return max(float(np.quantile(sizes, 0.95)), 1.0)


def _sd_variance(error: Array, freedom: int) -> float:
    """Variance of the relative error of the standard deviation of some values.

    From their fourth moment, as for independent ones; and from the means of their squares over batches (Schmeiser 1982,
    Batch size effects in the analysis of simulation output, Operations Research 30), because the squares of a
    model whose fit varies with the operating point are correlated. The larger of the two.
    """
    squares = error**2
    mean = float(squares.mean())
    if mean <= 0.0:
        return 1.0 / (2.0 * freedom)
    independent = (max(float((squares**2).mean()) / mean**2, 1.5) - 1.0) / (4.0 * freedom)
    size = squares.size // 10  # ten batches are longer than the correlation of the squares
    if size < 2:
        return independent
    batches = squares[: size * 10].reshape(10, size).mean(axis=1)
    return max(independent, float(batches.var(ddof=1)) / (4.0 * mean**2 * 10))


def memory_sds(e: Array, weight: float, doubt: float = 3.0) -> tuple[float, ...]:
    """Standard deviation of each signal that charts with a memory use; 1 if its residual is white.

    An autoregression of few coefficients may miss a correlation over many rows. It shows in averages: theirs should
    have the variance weight / (2 - weight). Where it is larger by more than chance allows, limits follow it.

    Args:
        e: prewhitened residuals, shape (rows, signals); NaN where there is none.
        weight: weight of the newest row in the averages.
        doubt: standard deviations by which a variance has to be larger; 0 where correlation is expected, as of the
            errors of a linear model, which are alike at one point of operation.
    """
    sds = []
    for column in e.T:
        column = column[np.isfinite(column)]
        squares = float(np.sum(ewma(column[:, None], weight) ** 2))
        ratio = squares / max(len(column), 1) * (2.0 - weight) / weight
        independent = max(len(column) * weight / 2.0, 1.0)
        sds.append(sqrt(ratio) if ratio > 1.0 + doubt * sqrt(2.0 / independent) else 1.0)
    return tuple(sds)


def memory_covariance(e: Array, correlations: Array, weight: float) -> Array:
    """Covariance of signals that a chart of their joint average uses, shape (signals, signals).

    Residuals that are white one by one may still be correlated with each other over several rows, as when one
    disturbance reaches two signals at different times. The covariance of their averages is then

        C(0) + sum over k of (1 - weight)^k (C(k) + C(k)'),

    with C(k) that of rows k apart, in units of weight / (2 - weight). It is summed over the lags that the
    autoregressions have. A direction keeps the variance of independent rows unless this one is larger than the largest
    that chance gives in one training of a hundred (Johnstone 2001, On the distribution of the largest eigenvalue in
    principal components analysis, Annals of Statistics 29).

    Args:
        e: prewhitened residuals without missing ones, shape (rows, signals).
        correlations: covariance for independent rows, same shape as the result; positive definite.
        weight: weight of the newest row in the averages.
    """
    rows, count = e.shape
    freedom = rows / (1.0 + 2.0 * LARGEST_ORDER)  # an average of so few rows has as large an error in its variance
    if freedom <= count:
        return correlations
    root = np.linalg.cholesky(correlations)
    white = np.linalg.solve(root, (e - e.mean(axis=0)).T)
    products = white @ white.T / rows
    for lag in range(1, LARGEST_ORDER + 1):
        lagged = (1.0 - weight) ** lag * (white[:, lag:] @ white[:, :-lag].T) / rows
        products += lagged + lagged.T
    sizes, directions = np.linalg.eigh(products)
    edge = sqrt(freedom - 1.0) + sqrt(count)
    spread = edge * (1.0 / sqrt(freedom - 1.0) + 1.0 / sqrt(count)) ** (1.0 / 3.0)
    chance = (edge**2 + 2.02 * spread) / freedom  # 2.02: of the Tracy-Widom distribution of order 1, at 99 %
    larger = np.where(sizes > chance, sizes - 1.0, 0.0)
    if not larger.any():
        return correlations
    turned = root @ directions
    found = correlations + (turned * larger) @ turned.T
    return np.asarray(0.5 * (found + found.T))


WHITENER = np.dtype(
    [
        ("constant", "f8"),
        ("coefficients", "f8", (LARGEST_ORDER,)),
        ("sd", "f8"),
        ("sd_variance", "f8"),
        ("passed_variance", "f8"),
        ("past", "f8", (LARGEST_ORDER,)),  # newest first
        ("expected", "f8"),
        ("rows", "i4"),
        ("order", "i4"),
        ("count", "i4"),  # number of past values
    ],
    align=True,
)
"""Numbers of a prewhitening filter: its autoregression and its past values."""


@jit
def expected_value(p: Any) -> float:
    """Prediction of the next z; its mean while there are too few past values."""
    value = p.constant
    if p.count < p.order:
        total = 0.0
        for k in range(p.order):
            total += p.coefficients[k]
        return float(value / (1.0 - total))
    for k in range(p.order):
        value += p.coefficients[k] * p.past[k]
    return float(value)


@jit
def add_past(p: Any, z: float) -> None:
    """Add a value to the past ones."""
    for k in range(LARGEST_ORDER - 1, 0, -1):
        p.past[k] = p.past[k - 1]
    p.past[0] = z
    p.count = min(p.count + 1, max(p.order, 1))


@jit
def innovation(p: Any, z: float) -> float:
    """Innovation of the next value in units of sigma; NaN for NaN, which clears the past, and for too few values."""
    if not abs(z) < inf:
        p.count = 0
        return nan
    is_known = p.count >= p.order
    p.expected = expected_value(p)
    add_past(p, z)
    return float((z - p.expected) / p.sd) if is_known else nan


@jit
def _expected_value(numbers: Any) -> float:
    return expected_value(numbers[0])


@jit
def _innovations(numbers: Any, z: Array) -> int:
    for i in range(z.size):
        z[i] = innovation(numbers[i], z[i])
    return int(z.size)


_EXPECTED_VALUE, _INNOVATIONS = Entry(_expected_value), Entry(_innovations)


def innovations(numbers: NDArray[np.void], z: Sequence[float]) -> list[float]:
    """Innovations of the next values of several filters, see `Prewhitener.update`.

    Args:
        numbers: numbers of the filters, shape (filters,).
        z: the next value of each; NaN if it is missing.
    """
    values = np.array(z, dtype=np.float64)
    _INNOVATIONS.call(numbers, values)
    e: list[float] = values.tolist()
    return e


class Prewhitener:
    """Computes the innovations of a residual, value by value.

    Args:
        learned: the autoregression; None: the numbers have it.
        numbers: numbers of the filter, shape (1,), as a view of those of a plant; None: its own.

    Attributes:
        numbers: the autoregression and the last values: what runs, and what is stored.
    """

    def __init__(self, learned: Prewhitening | None, numbers: NDArray[np.void] | None = None) -> None:
        self.numbers = np.zeros(1, WHITENER) if numbers is None else numbers
        if learned is not None:
            self.start(learned)

    def start(self, learned: Prewhitening) -> None:
        """Start with an autoregression, before the first value."""
        order, past = len(learned.coefficients), np.zeros(LARGEST_ORDER)
        coefficients = np.array([*learned.coefficients, *past[order:]])
        self.numbers[0] = (
            *(learned.constant, coefficients, learned.sd, learned.sd_variance, learned.passed_variance),
            *(past, 0.0, learned.rows, order, 0),
        )

    @property
    def autoregression(self) -> Prewhitening:
        """The autoregression."""
        p = self.numbers[0]
        return Prewhitening(
            float(p["constant"]),
            tuple(p["coefficients"][: p["order"]].tolist()),
            float(p["sd"]),
            int(p["rows"]),
            float(p["sd_variance"]),
            float(p["passed_variance"]),
        )

    @property
    def is_ready(self) -> bool:
        """True if there are enough past values for an innovation of the next one."""
        p = self.numbers[0]
        return bool(p["count"] == max(p["order"], 1))

    def expected_value(self) -> float:
        """Prediction of the next z; its mean while there are too few past values."""
        value: float = _EXPECTED_VALUE.call(self.numbers)
        return value

    def update(self, z: float) -> float:
        """Innovation of the next value in units of sigma; NaN for NaN.

        A gap clears the past; the innovation is NaN until there are enough values again.

        Args:
            z: the next value; NaN if it is missing.
        """
        return innovations(self.numbers, [z])[0]

    def reject_last(self) -> None:
        """Treat the last value as an outlier: replace it by its prediction."""
        p = self.numbers[0]
        p["past"][0] = p["expected"]

    def restart(self) -> None:
        """Forget the values seen."""
        self.numbers["count"] = 0
