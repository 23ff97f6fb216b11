"""Slow levels of outputs, less what inputs explain, as processes whose memory is uncertain; limits of them.

A level is the exponentially weighted average A of an output, less what the inputs explain of it: their averages of the
same weight, with a first-order lag of 1, 4 or 16 times that of the average, or with one between two of these. Which of
them explain an output is chosen by Schwarz's criterion (1978, Estimating the dimension of a model, Ann. Statist. 6).

How far a level comes by chance depends on its memory, of which a training shows little. So the memory is not estimated
but weighed. The averages are sampled every `2 / weight - 1` rows and regressed on those of the inputs with errors that
are a first-order autoregression r. For each r of a grid

- the restricted likelihood, with coefficients and variance integrated out (Harville 1974, Bayesian inference for
  variance components using only error contrasts, Biometrika 61), gives r its weight; a priori -log r is uniform, and r
  forgets within half the training: a longer memory cannot be distinguished from a mean;
- the variance v of the level follows from that of the innovations, which is known well, with Student's distribution
  for its error, and so does that of the regression.

Averages are smooth, so their samples seem to remember for longer than the signal (by 1.5 to 2 times): limits are
rather too wide. Where outputs are several, their memories are alike: a priori r has the mean of the others' weights
(Efron & Morris 1973, Stein's estimation rule and its competitors, J. Amer. Statist. Assoc. 68).

A stationary process of standard deviation s leaves +-x as often as neighbours lie on two sides of a limit,

    2 P(A <= x, A' > x) = 4 T(x / s, sqrt(d / (4 - d))),

T being Owen's (1956, Tables for computing bivariate normal probabilities, Ann. Math. Statist. 27) and d the mean square
of its steps, which the training shows, over s^2; for small d it is the formula of Rice (1944, Mathematical analysis of
random noise, Bell System Techn. J. 23). The limit x is where the mean of this rate over r is 1 / ARL0. Levels that are
not normal, such as the error of the regression where a plant is not linear, come farther: x is not below that of a
normal process whose largest level in the rows of the training is the one that came, with inputs also in blocks of rows
whose response is that of the others (`largest_in_blocks`).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import numpy as np
from scipy import special

from reactorwatch.arrays import Array, block_bounds
from reactorwatch.spc.averages import ewma

FEWEST_SAMPLES = 10
"""Least number of samples beside two for each input; of fewer, Student's limits are beyond what a fault does."""

MEMORIES = 25
"""Memories of the grid: neighbours differ by a quarter or less, where a training tells them apart by a third."""

LAGS = 4
"""Averages of each input: without a lag, and with 1, 4 and 16 times that of the chart. A lag between two neighbours is
their mixture to some percent. Of an average of which the training has fewer than `FEWEST_SAMPLES` independent values it
does not show what comes of it: one of 160 rows had 1.6 times the true gain of a heater after 1,000 rows."""

SETS = ((0,), (1,), (2,), (3,), (0, 1), (1, 2), (2, 3))
"""Sets of averages of the inputs, of which one explains an output: a lag, or one between two neighbours."""


class InputResponse(NamedTuple):
    """Response of outputs to inputs, by regression on lagged averages of the inputs.

    Attributes:
        gains: coefficients of the outputs on the averages of the inputs, shape (p, 4 k), those of an input together.
        ranges: largest average of each input in the training, without a lag, shape (k,).
        leverage: matrix of the leverage of the averages, shape (4 k, 4 k).
        before: largest effect of the averages with a lag on each output in the training, shape (p,).
        slowest: weight of the slowest average that explains an output.
    """

    gains: Array
    ranges: Array
    leverage: Array
    before: Array
    slowest: float


class SlowLevels(NamedTuple):
    """Levels of the outputs in a training, as stationary processes whose memory is uncertain.

    Attributes:
        centres: mean of each signal, the inputs first, shape (k + p,).
        response: response to the inputs.
        sds: standard deviation of each level, shape (p,).
        steps: mean square of its steps, shape (p,).
        weights: weight of each memory, shape (memories, p).
        variances: variance of the level by memory, shape (memories, p).
        errors: variance of the regression by memory, at the mean, shape (memories, p).
        freedom: degrees of freedom of the innovations' variance.
        largest: largest size of each level in the training, also in blocks that were held out, shape (p,).
        rows: number of rows of the training.
    """

    centres: Array
    response: InputResponse
    sds: Array
    steps: Array
    weights: Array
    variances: Array
    errors: Array
    freedom: float
    largest: Array
    rows: float

    @classmethod
    def of(cls, values: Array, k: int, weight: float) -> Self:
        """Learn them from the rows of a training, shape (rows, k + p), k inputs first.

        Args:
            values: rows without missing values.
            k: number of inputs.
            weight: weight of the newest row in an average.
        """
        centres, spacing = values.mean(axis=0), sample_spacing(weight)
        count = len(values) // spacing - 1
        driving = np.zeros((len(values), k, LAGS))
        driving[:, :, 0] = ewma(values[:, :k] - centres[:k], weight)
        for lag in range(1, LAGS):
            driving[:, :, lag] = ewma(driving[:, :, 0], weight * 0.25 ** (lag - 1))
        averages = ewma(values[:, k:] - centres[k:], weight)
        sampled = slice(len(values) - 1 - (count - 1) * spacing, None, spacing)
        y, memories = averages[sampled], np.geomspace(0.2, 0.5 * count, MEMORIES)  # in samples
        shown = np.array([1.0, *(weight * 0.25**lag for lag in range(LAGS - 1))]) * len(values) >= 2 * FEWEST_SAMPLES
        sets = [lags for lags in SETS if k and shown[max(lags)]] or [SETS[0]]
        fits = [_Fit.of(driving[sampled][:, :, list(lags)], y, memories) for lags in sets]
        best = np.argmax([item.scores for item in fits], axis=0).tolist()
        chosen = [fits[item] for item in best]
        weights = _weigh(np.stack([item.likelihood[:, i] for i, item in enumerate(chosen)], axis=1), 1.0 / memories)
        variances, errors = np.zeros((2, *weights.shape))
        gains, leverage = np.zeros((y.shape[1], k * LAGS)), np.zeros((k * LAGS, k * LAGS))
        for i, (fit, index) in enumerate(zip(chosen, best, strict=True)):
            columns, w = (np.arange(k)[:, None] * LAGS + sets[index]).ravel(), weights[:, i]
            variances[:, i] = fit.variances[:, i]
            errors[:, i] = fit.variances[:, i] * fit.inverses[:, 0, 0]
            centres[k + i] += w @ fit.coefficients[:, 0, i]
            gains[i, columns] = w @ fit.coefficients[:, 1:, i]
            inverse = np.einsum("r,rij->ij", w, fit.inverses[:, 1:, 1:])
            leverage[np.ix_(columns, columns)] += inverse / y.shape[1]  # that of the outputs on average
        lagging = driving.copy()
        lagging[:, :, 0] = 0.0
        explained, before = (item.reshape(len(values), -1) @ gains.T for item in (driving, lagging))
        levels = averages - (centres[k:] - values[:, k:].mean(axis=0)) - explained
        steps = np.mean(np.diff(levels[spacing:], axis=0) ** 2, axis=0)
        slowest = max((max(sets[item]) for item in best), default=0)
        return cls(
            centres,
            InputResponse(
                gains,
                np.max(np.abs(driving[:, :, 0]), axis=0),
                leverage,
                np.max(np.abs(before), axis=0),
                weight * 0.25 ** (slowest - 1) if slowest else 1.0,
            ),
            np.sqrt(np.sum(weights * variances, axis=0)),
            steps,
            weights,
            variances,
            errors,
            min(item.freedom for item in chosen),
            np.maximum(
                np.max(np.abs(levels[spacing:]), axis=0),
                largest_in_blocks(driving[spacing:], averages[spacing:], [sets[item] for item in best]) if k else 0.0,
            ),
            float(len(values)),
        )

    def rates(self, limits: Array) -> Array:
        """Crossings of the limit of each average in a row, by memory, shape (memories, p)."""
        beyond = special.stdtr(self.freedom, -limits / np.sqrt(self.variances + self.errors))
        return crossing_rate(-special.ndtri(np.maximum(beyond, 1e-300)), self.steps / self.variances)

    def usual(self, share: float) -> Array:
        """Size of each level beyond which a share of sound rows is, on average over the memories."""
        sds = np.sqrt(self.variances + self.errors)
        return self._limits(
            lambda sizes: 2.0 * np.sum(self.weights * special.stdtr(self.freedom, -sizes / sds), axis=0), 1.0 / share
        )

    def limits(self, arl0: float) -> Array:
        """Limit of each level: crossed once in `arl0` rows on average over the memories, or by the largest so far."""

        def normal(limits: Array) -> Array:
            return crossing_rate(limits / self.sds, self.steps / self.sds**2)

        weighed = self._limits(lambda limits: np.sum(self.weights * self.rates(limits), axis=0), arl0)
        return np.maximum(weighed, self.largest * self._limits(normal, arl0) / self._limits(normal, self.rows))

    def _limits(self, rates: Callable[[Array], Array], run_length: float) -> Array:
        """Limits with so many rows to a crossing, at least half a standard deviation."""
        low, high = 0.5 * self.sds, 1e3 * self.sds
        for _ in range(40):
            middle = np.sqrt(low * high)
            often = rates(middle) > 1.0 / run_length
            low, high = np.where(often, middle, low), np.where(often, high, middle)
        return high


class _Fit(NamedTuple):
    """Regression of outputs on averages of the inputs, for each memory of the errors.

    Attributes:
        likelihood: logarithm of the restricted likelihood, shape (memories, p).
        variances: variance of the errors, shape (memories, p).
        coefficients: shape (memories, 1 + regressors, p), the constant first.
        inverses: variances of the coefficients over that of the errors, shape (memories, 1 + regressors, same).
        scores: half of Schwarz's criterion, the larger the better, shape (p,).
        freedom: degrees of freedom of the variances.
    """

    likelihood: Array
    variances: Array
    coefficients: Array
    inverses: Array
    scores: Array
    freedom: float

    @classmethod
    def of(cls, regressors: Array, y: Array, memories: Array) -> Self:
        """Fit outputs, shape (samples, p), to regressors, shape (samples, inputs, lags)."""
        count, design = len(y), np.column_stack([np.ones(len(y)), regressors.reshape(len(y), -1)])
        freedom, found = float(count - design.shape[1]), []
        for r in np.exp(-1.0 / memories).tolist():
            x, e, free = _innovations(design, r), _innovations(y, r), 1.0 - r * r
            inverse = np.linalg.pinv(x.T @ x)
            coefficients = inverse @ x.T @ e
            squares = np.sum((e - x @ coefficients) ** 2, axis=0).clip(1e-300)
            likelihood = 0.5 * (np.log(free) - np.linalg.slogdet(x.T @ x)[1] - freedom * np.log(squares))
            unrestricted = 0.5 * (np.log(free) - count * np.log(squares))
            found.append((likelihood, squares / freedom / free, coefficients, free * inverse, unrestricted))
        likelihood, variances, coefficients, inverses, unrestricted = map(np.array, zip(*found, strict=True))
        scores = unrestricted.max(axis=0) - 0.5 * np.log(count) * design.shape[1]
        return cls(likelihood, variances, coefficients, inverses, scores, freedom)


def largest_in_blocks(driving: Array, averages: Array, sets: Sequence[tuple[int, ...]]) -> Array:
    """Largest size of each level in blocks of the rows, as a regression on the other rows has it, shape (p,).

    A response to inputs that the rows determine is the same in all blocks. One set point more, or a plant that is not
    linear, makes another.

    Args:
        driving: averages of the inputs, shape (rows, k, lags).
        averages: averages of the outputs, shape (rows, p).
        sets: lags that explain each output.
    """
    rows, found = len(averages), []
    for average, lags in zip(averages.T, sets, strict=True):
        design, levels = np.column_stack([np.ones(rows), driving[:, :, list(lags)].reshape(rows, -1)]), np.empty(rows)
        for first, end in block_bounds(rows):
            others = np.r_[0:first, end:rows]
            coefficients = np.linalg.lstsq(design[others], average[others])[0]
            levels[first:end] = average[first:end] - design[first:end] @ coefficients
        found.append(np.max(np.abs(levels)))
    return np.array(found)


def sample_spacing(weight: float) -> int:
    """Number of rows after which an average has forgotten the most."""
    return max(round(2.0 / weight) - 1, 1)


def crossing_rate(limit: Array, step: Array) -> Array:
    """Mean number of crossings of +- a limit, outwards, by a stationary normal process, in a row.

    Args:
        limit: limit in standard deviations.
        step: mean square of the steps from row to row over the variance; independent values have 2.
    """
    bounded = np.minimum(step, 2.0)
    return np.asarray(4.0 * special.owens_t(limit, np.sqrt(bounded / (4.0 - bounded))))


def _innovations(rows: Array, r: float) -> Array:
    """Innovations of a first-order autoregression, the first row scaled to their variance."""
    return np.concatenate([np.sqrt(1.0 - r * r) * rows[:1], rows[1:] - r * rows[:-1]])


def _weigh(likelihood: Array, prior: Array) -> Array:
    """Weights of the memories of each output, shape (memories, p), each with the mean of the others' as its prior."""
    likelihoods, first = np.exp(likelihood - likelihood.max(axis=0)), prior / prior.sum()
    p = likelihoods.shape[1]
    weights = first[:, None] * likelihoods / (first @ likelihoods)
    for _ in range(20 if p > 1 else 0):  # to some percent
        priors = (first[:, None] + weights.sum(axis=1, keepdims=True) - weights) / p
        weights = priors * likelihoods
        weights /= weights.sum(axis=0)
    return np.asarray(weights)
