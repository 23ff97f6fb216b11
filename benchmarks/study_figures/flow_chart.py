"""The report's flow chart from data to verdict, with the answer to each question and its reason.

    data -> is the sampling rate good? -no-> sample again
                 | yes
            model, from the trusted rows; limits: mean +- 3 sigma of its residual there (SPC)
                 |
            is there a mismatch in the other rows? -no-> fault free
                 | yes
            are the parameters accurate there? -no-> identify again
                 | yes
               fault

With a true model 0.27 % of the residuals are outside their limits; if the share in training is larger, it is used
instead. There is a mismatch if the number outside is improbable under that share (binomial). Parameters are accurate
for a row if their uncertainty contributes less to its prediction error than noise does, phi' cov phi < sigma^2; that
fails outside the operating range of the training.
"""

import math
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.errors import InputError
from reactorwatch.identification.checks import Check, check_record, sampling
from reactorwatch.identification.data import ScaledRecord, rows_of
from reactorwatch.identification.linear import fit_linear
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.structure import Structure, as_columns

OUTSIDE_THREE_SIGMA = 0.0027
MISMATCH_MINUS_LOG10_P = 6.0


class Branch(msgspec.Struct, frozen=True):
    """One question of the chart."""

    question: str  # the question
    answer: str  # "yes" or "no"
    why: str  # the numbers behind the answer


@dataclass(frozen=True)
class Conclusion:
    """Result of the chart."""

    verdict: str  # "sample again", "fault free", "identify again" or "fault"
    branches: tuple[Branch, ...]  # the questions in order
    model: LinearModel | None = None  # the fitted model; None if the chart ended before it
    lower_limit: float = math.nan  # lower limit of the residual, in the output's unit; NaN without a model
    upper_limit: float = math.nan  # upper limit of the residual; NaN without a model


def follow(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
    trusted_rows: int | None = None,
) -> Conclusion:
    """Apply the chart to a record."""
    u, y = as_columns(inputs, "inputs", structure.inputs), as_columns(outputs, "outputs", 1)
    t = np.arange(len(y), dtype=np.float64) if time is None else np.asarray(time, dtype=np.float64)
    trusted = len(y) // 2 if trusted_rows is None else trusted_rows
    if not 0 < trusted < len(y):
        raise InputError(f"trusted_rows must be between 1 and {len(y) - 1}, got {trusted}")
    training, watched = (u[:trusted], y[:trusted], t[:trusted]), (u[trusted:], y[trusted:], t[trusted:])

    for check in check_record(structure, *training):
        if check.name in ("variation", "excitation") and not check.passed:
            raise InputError(check.result)
    rate = sampling(ScaledRecord.of(structure, *training))
    branches = [_branch("is the sampling rate good?", rate.passed, _sampling_text(rate))]
    if not rate.passed:
        return Conclusion("sample again", tuple(branches))

    model = fit_linear("arx", structure, *training)
    known = _present(model.residuals(*training))
    centre, sigma = float(np.mean(known)), float(np.std(known, ddof=structure.parameters))
    lower, upper = centre - 3.0 * sigma, centre + 3.0 * sigma
    usual = max(OUTSIDE_THREE_SIGMA, float(np.mean((known < lower) | (known > upper))))
    residuals = model.residuals(*watched)[:, 0]
    present = np.isfinite(residuals)
    if not np.any(present):
        raise InputError(f"none of the {len(residuals)} rows after the trusted ones can be predicted")
    outside = present & ((residuals < lower) | (residuals > upper))
    improbable = _minus_log10_tail(int(outside.sum()), int(present.sum()), usual)
    mismatch = improbable >= MISMATCH_MINUS_LOG10_P
    why = (
        f"{outside.sum()} of {present.sum()} residuals are outside {lower:.3g} to {upper:.3g}, "
        f"{100 * usual:.2g} % are usual: -log10 p = {improbable:.1f}"
    )
    branches.append(_branch("is there a mismatch?", mismatch, why))
    if not mismatch:
        return Conclusion("fault free", tuple(branches), model, lower, upper)

    rows = rows_of(structure, *watched)
    regressors = rows.regressors[np.isin(rows.position, np.flatnonzero(outside))]
    added = np.einsum("ij,jk,ik->i", regressors, model.covariance, regressors)
    ratio = math.sqrt(float(np.median(added))) / sigma if sigma > 0.0 else 0.0
    accurate = ratio < 1.0
    why = (
        f"uncertain parameters add {ratio:.2g} of the noise's standard deviation to those predictions, at most 1 may be"
    )
    branches.append(_branch("are the parameters accurate?", accurate, why))
    return Conclusion("fault" if accurate else "identify again", tuple(branches), model, lower, upper)


def _branch(question: str, answer: bool, why: str) -> Branch:
    return Branch(question, "yes" if answer else "no", why)


def _sampling_text(rate: Check) -> str:
    return f"a step response takes {rate.value:.0f} samples" if rate.passed else rate.result


def _present(residuals: ArrayLike) -> "np.ndarray[tuple[int], np.dtype[np.float64]]":
    values = np.asarray(residuals, dtype=np.float64).ravel()
    return values[np.isfinite(values)]


def _minus_log10_tail(count: int, of: int, share: float) -> float:
    """-log10 of the probability of at least `count` among `of` rows, each with the probability `share`."""
    from scipy.stats import binom

    if count == 0:
        return 0.0
    logarithm = float(binom.logsf(count - 1, of, share))
    if math.isfinite(logarithm):
        return abs(logarithm) / math.log(10.0)
    # Chernoff's bound, where the probability itself underflows: -log p >= of D(count / of || share).
    seen = count / of
    rest = (1.0 - seen) * math.log((1.0 - seen) / (1.0 - share)) if seen < 1.0 else 0.0
    return of * (seen * math.log(seen / share) + rest) / math.log(10.0)
