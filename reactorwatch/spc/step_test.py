"""Test of a lasting step of a measurement against single outliers, in the innovations of any predictor.

A predictor that uses the last measurements follows a step: its innovations show it for a few rows, and then hardly at
all, so an average or a sum of them does not see it. But these rows have a known form. The step response s of the
innovations follows from the model; an outlier in one row has the response p[j] = s[j] - s[j-1]. For each onset among
the last `ONSETS` rows, the size of a step is fitted by least squares, and for each of the last `ROWS` rows that of an
outlier. With J and P the parts of the sum of squares that each explains, the statistic is

    sqrt(max J - max P), with the sign of the step,

0 where an outlier explains the rows as well. (Generalised likelihood ratio: Willsky & Jones 1976, A generalized
likelihood ratio approach to the detection and estimation of jumps in linear systems, IEEE Trans. Automatic Control 21;
level shifts against outliers: Tsay 1988, Outliers, level shifts, and variance changes in time series, Journal of
Forecasting 7.) Each J has one degree of freedom, so by chance one of them is beyond a limit L at most at the rate of
the number of onsets times 2 Phi(-L) a row.

An onset has to be at least `FEWEST_LATER` rows ago, since a step is one that lasts.

The test computes the innovations itself, of all rows: a row that another stage holds back as a possible outlier may be
the first row of a step.
"""

from math import nan, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.spc.false_alarm_budget import return_level, widen_limit
from reactorwatch.spc.prewhitening import (
    LARGEST_ORDER,
    WHITENER,
    Prewhitener,
    Prewhitening,
    add_past,
    expected_value,
)

ONSETS = 20
"""Rows since an onset that is still tested."""

FEWEST_LATER = 2
"""Fewest rows after an onset."""

ROWS = ONSETS + LARGEST_ORDER
"""Rows that may have the outlier: the response to one goes on after it."""

STEP_TEST = np.dtype(
    [
        ("response", "f8", (ROWS,)),  # innovations after a step of one unit of the signal
        ("limit", "f8"),
        ("marginal_sd", "f8"),  # standard deviation of the residual, for rows after a missing one
        ("whitener", WHITENER),
        ("recent", "f8", (ROWS,)),  # newest innovations, newest first; NaN where there is none
        ("size", "f8"),  # of the step that explains them best, in units of the signal
        ("rows", "f8"),  # rows since its onset
    ],
    align=True,
)
"""Numbers of the test of one signal."""


class StepPoint(NamedTuple):
    """Result of a row.

    Attributes:
        statistic: see the module; NaN in a row without a residual.
        limit: limit of its size.
        size: fitted size of the step, in units of the signal.
        rows: rows since its onset.
    """

    statistic: float
    limit: float
    size: float
    rows: int


@jit
def _innovation(p: Any, z: float) -> float:
    """Innovation of a residual; one after a missing residual is taken about the mean."""
    w = p.whitener
    e = (z - expected_value(w)) / (w.sd if w.count >= w.order else p.marginal_sd)
    add_past(w, z)
    return float(e)


@jit
def update_step_test(p: Any, z: float) -> float:
    """Update the test of a signal with the residual of a row; returns its signed statistic, NaN without a residual."""
    if abs(z) < np.inf:
        e = _innovation(p, z)
    else:
        p.whitener.count = 0
        e = nan
    for k in range(ROWS - 1, 0, -1):
        p.recent[k] = p.recent[k - 1]
    p.recent[0] = e
    explained, size, rows = 0.0, 0.0, 0.0
    for age in range(FEWEST_LATER, ONSETS):
        total, norm = 0.0, 0.0
        for i in range(age + 1):
            if p.recent[i] == p.recent[i]:
                response = p.response[age - i]
                total += response * p.recent[i]
                norm += response * response
        if norm > 0.0 and total * total / norm > explained:
            explained, size, rows = total * total / norm, total / norm, float(age)
    outlier = 0.0
    for age in range(ROWS):
        total, norm = 0.0, 0.0
        for i in range(age + 1):
            if p.recent[i] == p.recent[i]:
                j = age - i
                response = p.response[j] - (p.response[j - 1] if j else 0.0)
                total += response * p.recent[i]
                norm += response * response
        if norm > 0.0:
            outlier = max(outlier, total * total / norm)
    p.size, p.rows = size, rows
    if e != e:
        return nan
    statistic = np.sqrt(max(explained - outlier, 0.0))
    return float(statistic if size > 0.0 else -statistic)


@jit
def _update_all(numbers: Any, z: Array, statistics: Array) -> bool:
    """Update the tests of all signals; returns True if one is beyond its limit."""
    is_out = False
    for i in range(z.size):
        statistics[i] = update_step_test(numbers[i], z[i])
        is_out = is_out or abs(statistics[i]) > numbers[i].limit
    return is_out


_UPDATE = Entry(_update_all)


class StepTests:
    """Tests of the signals of a plant.

    Args:
        numbers: numbers of the tests, shape (signals,), see `STEP_TEST`.

    Attributes:
        numbers: the same: what runs, and what is stored.
    """

    def __init__(self, numbers: NDArray[np.void]) -> None:
        self.numbers = numbers
        self._statistics: Array = np.empty(len(numbers))

    @classmethod
    def learn(cls, responses: Array, z: Array, learned: list[Prewhitening], arl0: float) -> "StepTests":
        """Learn the tests of some signals from a training.

        Args:
            responses: response of each signal's residual to a lasting step of one unit, shape (signals, rows).
            z: residuals of the training, shape (rows, signals); NaN where there is none.
            learned: prewhitening of each residual.
            arl0: run length of each test without a fault, in rows.
        """
        numbers = np.zeros(len(learned), STEP_TEST)
        for i, (response, column, item) in enumerate(zip(responses, z.T, learned, strict=True)):
            p = numbers[i]
            known = column[np.isfinite(column)]
            p["marginal_sd"] = max(float(known.std()) if known.size else 0.0, item.sd)
            Prewhitener(item, numbers["whitener"][i : i + 1])
            p["response"] = np.nan_to_num(step_response(response, item))
            p["recent"] = nan
        tests = cls(numbers)
        statistics = np.empty(z.shape)
        for row, values in enumerate(z.tolist()):
            tests.update(values)
            statistics[row] = tests._statistics
        for i, item in enumerate(learned):
            numbers[i]["limit"] = design_limit(statistics[:, i], item, arl0)
        tests.restart()
        return tests

    def point(self, signal: int) -> StepPoint:
        """Newest result of a signal."""
        p = self.numbers[signal]
        return StepPoint(float(self._statistics[signal]), float(p["limit"]), float(p["size"]), int(p["rows"]))

    def update(self, z: list[float]) -> bool:
        """Update with a row; returns True if a statistic is beyond its limit.

        Args:
            z: residual of each signal; NaN where there is none.
        """
        return bool(_UPDATE.call(self.numbers, np.array(z, dtype=np.float64), self._statistics))

    def sensitivity(self, signal: int) -> float:
        """Statistic after a lasting step of one unit of a signal, without noise: what no outlier explains of it."""
        step = self.numbers[signal]["response"][:ONSETS]
        outlier, explained = np.diff(step, prepend=0.0), 0.0
        for row in range(ONSETS):
            shape = np.r_[np.zeros(row), outlier[: ONSETS - row]]
            explained = max(explained, float(step @ shape) ** 2 / max(float(shape @ shape), 1e-300))
        return sqrt(max(float(step @ step) - explained, 0.0))

    def limit(self, signal: int) -> float:
        """Limit of the statistic of a signal."""
        return float(self.numbers[signal]["limit"])

    def restart(self) -> None:
        """Forget the rows seen."""
        self.numbers["recent"], self.numbers["whitener"]["count"] = nan, 0


def step_response(residual: Array, learned: Prewhitening) -> Array:
    """Response of the innovations to a step of one unit, shape (ROWS,).

    Args:
        residual: response of the residual, shape (ROWS,).
        learned: prewhitening of the residual.
    """
    response = residual.copy()
    for lag, coefficient in enumerate(learned.coefficients, start=1):
        response[lag:] -= coefficient * residual[:-lag]
    return np.asarray(response / learned.sd)


def design_limit(statistics: Array, learned: Prewhitening, arl0: float) -> float:
    """Limit of the statistic: that of normal innovations, or the one that the training's statistics ask for.

    Where tails are heavier than those of normal values, as at moves of an input, the limit follows (`return_level`).

    Args:
        statistics: statistics of the training, shape (rows,); NaN where there is none.
        learned: prewhitening of the residual.
        arl0: run length without a fault, in rows.
    """
    normal = widen_limit(-float(ndtri(0.5 / (arl0 * (ONSETS - FEWEST_LATER)))), 1.0, learned)
    return max(normal, return_level(statistics, arl0))
