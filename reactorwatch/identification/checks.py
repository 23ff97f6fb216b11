"""Checks that a record suffices to identify a model, each with the reason of a failure and its cure; residual tests.

Persistence of excitation (Ljung, System Identification, 2nd ed., chapter 13): a linear model of n parameters on past
outputs and m on past inputs needs an input of order n + m, one whose n + m lagged copies, less their means, are
linearly independent. A sinusoid excites 2, a sum of k sinusoids 2k, however long it lasts; a square wave or random
steps many more. Measured here as the smallest over the largest singular value of the lagged copies. Independence does
not depend on the spacing of the lags, but this measure does (neighbouring samples of a slow input are nearly equal), so
the best of several spacings counts; the sampling rate has a check of its own.

The sampling rate is judged by the plant's response to a step, T95 in samples: 5 to 15 are advised (Isermann and
Munchhof, Identification of Dynamic Systems, 2011, section 23.2). Above that neighbouring rows are nearly equal, the
regressors become singular, and noise outweighs what a sample adds; below it the response is over between two samples.
The step response is that of the instrumental variable model: least squares would take the noise for fast dynamics, and
accept every sampling rate.

Whiteness of residuals: Ljung and Box (Biometrika 65 (1978) 297), Q = N (N+2) sum_k r_k^2 / (N-k), r_k the
autocorrelation at lag k, is chi-squared with as many degrees of freedom as lags, less the number of fitted parameters
on the output's own past, if the residuals are white. Independence from past inputs: Soderstrom and Stoica (System
Identification, 1989, section 11.2), x = N r' R^-1 r with r the cross-covariances of residual and past inputs over the
residuals' standard deviation and R the covariance matrix of these past inputs, is chi-squared with as many degrees of
freedom as there are of them. The result is -log10 p, with p the probability of such a statistic under a true model: 6
is one in a million, and it stays finite where p itself underflows.
"""

import math
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.data import RunPlan, ScaledRecord, consecutive_rows
from reactorwatch.identification.linear import instrumental_variable
from reactorwatch.identification.linear_model import simulate
from reactorwatch.identification.structure import Delay, Structure, as_columns

LARGEST_CONDITION = 1e4  # of the scaled regressors: four digits are lost
SLOWEST_SAMPLES, BEST_SAMPLES, FASTEST_SAMPLES = 3.0, 10.0, 30.0  # T95: about twice beyond what is advised is accepted
LEAST_AMPLITUDE = 3.0  # of the output, in standard deviations of its noise
DEFAULT_LAGS = 20  # of residual tests; a model of many parameters needs more


class Check(msgspec.Struct, frozen=True):
    """Result of a check.

    Attributes:
        name: name of the check.
        result: "ok", or the reason of a failure and its cure.
        value: measured value.
        limit: limit of the value.
        decimation: advised decimation of the rows, of the check of the sampling rate; 1 if it is not too fast.
    """

    name: str
    result: str
    value: float
    limit: float
    decimation: int = 1

    @property
    def passed(self) -> bool:
        """True if the result is "ok"."""
        return self.result == "ok"


def check_record(
    structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None
) -> tuple[Check, ...]:
    """Run all checks of a record for a structure, in the order in which to cure failures.

    Args:
        structure: structure of the model.
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured. Without inputs there is no excitation
            and no step response to check.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,); None: gaps are not detected.

    Raises:
        InputError: shapes that don't fit, times that don't increase, or too few rows.
    """
    varied = variation(outputs)
    if not varied.passed:
        return (varied,)
    record = ScaledRecord.of(structure, inputs, outputs, time)
    if structure.inputs == 0:
        return varied, conditioning(record), amplitude(record)
    excited = persistence(inputs, structure.output_lags + structure.input_lags, time)
    conditioned = conditioning(record)
    if not excited.passed or conditioned.value == math.inf:
        return varied, excited, conditioned
    return varied, excited, sampling(record), conditioned, amplitude(record)


def variation(outputs: ArrayLike) -> Check:
    """Check that the output varies by more than its rounding."""
    values = np.asarray(outputs, dtype=np.float64)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return Check("variation", "the output has no measured value", 0.0, 0.0)
    spread, limit = float(np.std(values)), 1e-12 * float(np.max(np.abs(values)))
    constant = f"the output is constant, {values[0]:g}: there is nothing to identify"
    return Check("variation", "ok" if spread > limit else constant, spread, limit)


def persistence(inputs: ArrayLike, order: int, time: ArrayLike | None = None) -> Check:
    """Check that the input excites a model of a given number of parameters.

    Args:
        inputs: shape (rows,) or (rows, inputs).
        order: number of parameters on past outputs and past inputs together (for each input).
        time: shape (rows,); None: gaps are not detected.
    """
    u = as_columns(inputs, "inputs")
    run = consecutive_rows(u, time)
    found, spacing = 0, 1
    while found < order and spacing * (order - 1) <= max(len(u) // 4, order - 1):
        rows = np.flatnonzero(run > spacing * (order - 1))
        if rows.size >= 2 * order * u.shape[1]:
            found = max(found, _excited_order([u[rows - lag * spacing] for lag in range(order)]))
        spacing *= 2
    if found >= order:
        return Check("excitation", "ok", float(found), float(order))
    several = u.shape[1] > 1
    none = (
        "constant inputs, and inputs that move in proportion, excite none"
        if several
        else "a constant input excites none"
    )
    kind = {0: f" ({none})", 2: " (as a single sinusoid does)"}.get(found, "")
    subject, them = ("the inputs together excite", "each") if several else ("the input excites", "it")
    reason = (
        f"{subject} order {found}{kind}, order {order} is needed: move {them} in steps at irregular times, "
        f"or by a sum of at least {-(-order // 2)} sinusoids"
    )
    return Check("excitation", reason, float(found), float(order))


def _excited_order(copies: list[NDArray[np.float64]]) -> int:
    """Number of leading lagged copies that are linearly independent."""
    centred = [copy - copy.mean(axis=0) for copy in copies]
    size = np.linalg.norm(centred[0], axis=0)
    if np.any(size <= 1e-12 * np.max(np.abs(copies[0]), axis=0) * math.sqrt(len(copies[0]))):
        return 0
    inputs = centred[0].shape[1]
    triangle = np.asarray(np.linalg.qr(np.concatenate([copy / size for copy in centred], axis=1), mode="r"))
    for lags in range(len(copies), 0, -1):
        values = np.linalg.svd(triangle[: lags * inputs, : lags * inputs], compute_uv=False)
        if values[-1] >= 0.01 * values[0]:
            return lags
    return 0


def conditioning(record: ScaledRecord) -> Check:
    """Check that the scaled regressors determine the parameters.

    Raises:
        InputError: signals and times that don't fit, or fewer rows than parameters.
    """
    structure, regressors = record.structure, record.rows().regressors
    if len(regressors) < structure.parameters:
        raise UnfitRecordError(f"{structure.parameters} parameters need as many complete rows, got {len(regressors)}")
    condition = float(np.linalg.cond(regressors))
    value = condition if math.isfinite(condition) and condition < 1e16 else math.inf
    reason = (
        f"the regressors are nearly dependent, condition number {value:.1e}: "
        "lower the order, sample more slowly or excite more"
    )
    return Check("conditioning", "ok" if value <= LARGEST_CONDITION else reason, value, LARGEST_CONDITION)


def sampling(record: ScaledRecord) -> Check:
    """Check that the sampling is neither too fast nor too slow for the plant.

    Raises:
        InputError: too few rows, or rows that don't determine the parameters.
    """
    samples = response_samples(record.structure, instrumental_variable(record))
    if math.isnan(samples):
        reason = "cannot tell: the model found has no settled step response; a longer or livelier record would help"
        return Check("sampling", reason, math.nan, FASTEST_SAMPLES)
    if samples > FASTEST_SAMPLES:
        decimation = round(samples / BEST_SAMPLES)
        reason = (
            f"too fast: the response takes {samples:.0f} samples, {BEST_SAMPLES:.0f} suffice: take one of {decimation}"
        )
        return Check("sampling", reason, samples, FASTEST_SAMPLES, decimation)
    if samples < SLOWEST_SAMPLES:
        reason = (
            f"too slow: the response is over within {samples:.0f} samples: sample at least "
            f"{BEST_SAMPLES / samples:.0f} times faster"
        )
        return Check("sampling", reason, samples, SLOWEST_SAMPLES)
    return Check("sampling", "ok", samples, FASTEST_SAMPLES)


def response_samples(structure: Structure, parameters: NDArray[np.float64]) -> float:
    """Number of samples until a step response first reaches 95 % of its final value, without the delay.

    Of several inputs the one with the largest gain counts. NaN if there is no effect, or it does not settle.

    Args:
        structure: structure of the model.
        parameters: shape (parameters,), for scaled signals.
    """
    lags = structure.output_lags
    rest = 1.0 - float(np.sum(parameters[:lags]))
    gains = parameters[lags : lags + structure.input_lags * structure.inputs].reshape(-1, structure.inputs).sum(axis=0)
    strongest = int(np.argmax(np.abs(gains)))
    if rest <= 0.0 or gains[strongest] == 0.0:
        return math.nan
    final = gains[strongest] / rest
    length = 20_000 + structure.history
    step = np.zeros((length, structure.inputs))
    step[structure.history :, strongest] = 1.0
    starts = np.arange(length) == structure.history
    plan = RunPlan(starts, np.arange(length) >= structure.history)
    theta = parameters.copy()
    if structure.offset:
        theta[-1] = 0.0
    response = simulate(structure, theta, step, np.zeros((length, 1)), plan)[structure.history :, 0]
    reached = np.flatnonzero(response / final >= 0.95)
    return float(reached[0] - structure.delays[strongest] + 1) if reached.size else math.nan


def amplitude(record: ScaledRecord) -> Check:
    """Check that the output moves by more than its noise, the residual of an ARX model of twice the order.

    Raises:
        InputError: signals and times that don't fit.
    """
    structure = record.structure
    lags = 2 * structure.output_lags, 2 * structure.input_lags
    rich = Structure(*lags, structure.delay, structure.inputs, offset=structure.offset)
    rows = replace(record, structure=rich).rows()
    # Nearly dependent columns do not affect the residual.
    theta = np.linalg.lstsq(rows.regressors, rows.outputs)[0]
    residuals = rows.outputs - rows.regressors @ theta
    free = max(len(residuals) - rich.parameters, 1)
    noise = math.sqrt(float(np.sum(residuals * residuals)) / free)
    value = float(np.std(rows.outputs)) / noise if noise > 0.0 else math.inf
    reason = (
        f"the output moves by only {value:.1f} times its noise, {LEAST_AMPLITUDE:.0f} are needed: "
        "move the input further or average samples"
    )
    return Check("amplitude", "ok" if value >= LEAST_AMPLITUDE else reason, value, LEAST_AMPLITUDE)


class ResidualTest(msgspec.Struct, frozen=True):
    """Result of a test of residuals.

    Attributes:
        name: "whiteness" or "independence".
        statistic: test statistic, chi-squared under the null hypothesis.
        degrees: degrees of freedom.
        minus_log10_p: -log10 of its p-value; 0 when there are no residuals.
    """

    name: str
    statistic: float
    degrees: int
    minus_log10_p: float


def whiteness(residuals: ArrayLike, lags: int = DEFAULT_LAGS, fitted: int = 0) -> ResidualTest:
    """Ljung-Box test of whiteness.

    Args:
        residuals: shape (rows,), NaN where there is none; pairs with a missing one are excluded.
        lags: number of autocorrelations.
        fitted: parameters on the output's own past that were fitted to these residuals (an ARX model's `a`).

    Raises:
        InputError: lags that leave no degree of freedom, or fewer than two residuals a lag.
    """
    if lags <= fitted or lags < 1:
        raise InputError(f"lags must be above the {fitted} fitted parameters and at least 1, got {lags}")
    values, present = _centre(residuals, lags)
    count = int(present.sum())
    variance = float(np.sum(values * values))
    if variance == 0.0:
        return ResidualTest("whiteness", 0.0, lags - fitted, 0.0)
    statistic = 0.0
    for lag in range(1, lags + 1):
        pairs = int(np.sum(present[lag:] & present[:-lag]))
        if pairs:
            correlation = float(values[lag:] @ values[:-lag]) / variance
            statistic += correlation**2 / pairs
    statistic *= count * (count + 2.0)
    return ResidualTest("whiteness", statistic, lags - fitted, minus_log10_p(statistic, lags - fitted))


def independence(
    residuals: ArrayLike,
    inputs: ArrayLike,
    delay: Delay = 1,
    lags: int = DEFAULT_LAGS,
    time: ArrayLike | None = None,
) -> ResidualTest:
    """Test that the residuals are uncorrelated with past inputs.

    Args:
        residuals: shape (rows,), NaN where there is none.
        inputs: shape (rows,) or (rows, inputs).
        delay: the first lag that is tested, of all inputs or of each.
        lags: number of lags of each input.
        time: shape (rows,); None: gaps are not detected.

    Raises:
        InputError: fewer than two residuals a lag, or a delay or number of lags below 1.
    """
    delays = np.array(delay, dtype=np.int64)
    if delays.min() < 1 or lags < 1:
        raise InputError(f"delay and lags must be at least 1, got {delay} and {lags}")
    values, present = _centre(residuals, lags)
    u = as_columns(inputs, "inputs")
    if len(u) != values.size:
        raise InputError(f"residuals and inputs must have equally many rows, got {values.size} and {len(u)}")
    reach = int(delays.max()) + lags - 1
    rows = np.flatnonzero(present & (np.concatenate([[0], consecutive_rows(u, time)[:-1]]) >= reach))
    if rows.size <= reach:
        raise UnfitRecordError(
            f"{lags} lags need more than {reach} rows with a residual and past inputs, got {rows.size}"
        )
    past = np.concatenate([u[rows[:, None] - delays - lag, np.arange(u.shape[1])] for lag in range(lags)], axis=1)
    past = past - past.mean(axis=0)
    # A constant or duplicate input adds no direction; the projection counts independent ones.
    directions, sizes, _ = np.linalg.svd(past, full_matrices=False)
    directions = directions[:, sizes > 1e-9 * max(sizes[0], 1e-300)]
    errors = values[rows]
    variance = float(np.mean(errors * errors))
    degrees = directions.shape[1]
    if variance == 0.0 or degrees == 0:
        return ResidualTest("independence", 0.0, degrees, 0.0)
    statistic = float(np.sum((directions.T @ errors) ** 2)) / variance
    return ResidualTest("independence", statistic, degrees, minus_log10_p(statistic, degrees))


def minus_log10_p(statistic: float, degrees: int) -> float:
    """-log10 of the upper tail of chi-squared, for any tail however small.

    Beyond double range it is the continued fraction of the incomplete gamma function, DLMF 8.9.2, in logarithms.

    Args:
        statistic: value of chi-squared, at least 0.
        degrees: degrees of freedom, at least 1.
    """
    from scipy.special import gammaincc, gammaln

    a, x = 0.5 * degrees, 0.5 * statistic
    probability = float(gammaincc(a, x))
    if probability > 1e-200:
        return abs(math.log10(probability))
    # Lentz's method (Numerical Recipes, 3rd ed., section 6.2) for x well above a, where it converges in a few steps.
    b = x + 1.0 - a
    c, d = 1e300, 1.0 / b
    fraction = d
    for i in range(1, 1000):
        term = -i * (i - a)
        b += 2.0
        d = 1.0 / (term * d + b)
        c = b + term / c
        fraction *= d * c
        if abs(d * c - 1.0) < 1e-15:
            break
    return (x - a * math.log(x) + float(gammaln(a)) - math.log(fraction)) / math.log(10.0)


def _centre(residuals: ArrayLike, lags: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Residuals less their mean, 0 where missing, and a mask of those present."""
    values = np.asarray(residuals, dtype=np.float64)
    if values.ndim != 1:
        raise InputError(f"residuals must have the shape (rows,), got {values.shape}")
    present = np.isfinite(values)
    if present.sum() < 2 * lags:
        raise UnfitRecordError(f"{lags} lags need at least {2 * lags} residuals, got {int(present.sum())}")
    return np.where(present, values - np.mean(values[present]), 0.0), present
