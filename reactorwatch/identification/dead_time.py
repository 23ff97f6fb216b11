"""Dead time of each input, from a record.

The output is regressed on its own past and on many lags of all inputs together, since with feedback, or with inputs
that move together, the correlation of one input with the output misleads. The lags of an input are a response: nothing
during the dead time, then coefficients that leave zero gradually and decay. As a prior this is a random walk that
starts at zero behind the dead time, times an exponential (a kernel for impulse responses, as of Pillonetto, Dinuzzo,
Chen, De Nicolao and Ljung, Automatica 50 (2014) 657). The dead time is the one with the largest marginal likelihood, at
the best decay and size: where the first rows of a response are below the noise, they follow from those after them.
"""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from msgspec.structs import replace
from scipy.linalg import block_diag

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.data import Dataset, rows_of
from reactorwatch.identification.linear import fit_linear
from reactorwatch.identification.structure import Delay, Scaling, Structure

LONGEST = 25  # rows; the studied dead times end at 20, with 5 to spare
LAGS = LONGEST + 10  # the response after the longest dead time, whose rest the output's past describes
# Noise of measurement makes the equation of the output long; a lag more costs time.
OUTPUT_LAGS = 15
DECAYS = (0.6, 0.8, 0.9, 0.95, 0.98)  # of the variance of a response by a row: it lasts for 2 to 50 rows
SIZES = 10.0 ** np.arange(-8.0, 1.1, 0.5)  # variance of a step of the random walk, at inputs and output of spread 1
# Twice a difference of log likelihood, odds of 7: where more than half of the dead times are within it of the best, the
# record determines none, as where an input has no effect that shows, and the model keeps all lags.
UNDETERMINED = 4.0

DelayChoice: TypeAlias = int | str | dict[str, int]
"""Delay as it is asked for: a number of samples, `auto`, or one by the name of each input."""


def resolve_delay(delay: DelayChoice, data: Dataset) -> Delay:
    """Delay of a structure.

    Raises:
        InputError: an input that the record does not have or that has no delay, or a record that is too short.
    """
    if isinstance(delay, dict):
        if set(delay) != set(data.input_names):
            raise InputError(f"delay must name each of {', '.join(data.input_names)}, got {', '.join(delay)}")
        return tuple(delay[name] for name in data.input_names)
    if isinstance(delay, int):
        return delay
    if delay != "auto":
        raise InputError(f"delay must be a number of samples, auto, or one by input as u1=3,u2=15, got {delay!r}")
    return find_dead_times(data) if data.input_names else 1


def name_delays(delay: Delay, inputs: Sequence[str]) -> int | dict[str, int]:
    """Delay of a structure in an answer: by the name of each input where they differ."""
    return delay if isinstance(delay, int) else dict(zip(inputs, delay, strict=True))


def better_structure(structure: Structure, data: Dataset) -> Structure | None:
    """A structure with the dead times that are found; None where an ARX model predicts no better with them.

    Those that are a row off at most are kept, as the search is right to a row, and so are all where rows are too few.
    """
    try:
        found = replace(structure, delay=find_dead_times(data))
        here, there = (fit_linear("arx", item, *data.arrays).noise_sd for item in (structure, found))
    except InputError:
        return None
    is_better = there < here and np.max(np.abs(np.subtract(found.delays, structure.delays))) > 1
    return found if is_better else None


def find_dead_times(data: Dataset) -> tuple[int, ...]:
    """Dead time of each input in rows, from 1 to 25.

    Raises:
        InputError: too few complete rows for the regression, or an output that is constant in them.
    """
    count = data.inputs.shape[1]
    data, _ = data.split(min(data.rows, 20_000))  # ten times as many as the studied records: more take memory
    structure = Structure(OUTPUT_LAGS, LAGS, 1, count)
    scaling = Scaling.of(data.inputs, data.output)
    rows = rows_of(structure, scaling.inputs(data.inputs), scaling.outputs(data.output), data.time)
    freedom = len(rows.outputs) - structure.parameters
    if freedom <= structure.parameters:
        raise UnfitRecordError(
            f"the search of dead times needs more than {2 * structure.parameters} complete rows in succession, "
            f"got {len(rows.outputs)}: record for longer, or give --delay"
        )
    if np.ptp(rows.outputs) == 0.0:
        raise UnfitRecordError("the search of dead times needs an output that varies in complete rows")
    gram, moments = _regression(rows.regressors, rows.outputs[:, 0], count, freedom)
    factors = np.array([[_response_factor(delay, decay) for decay in DECAYS] for delay in range(1, LONGEST + 1)])
    priors = [1e-3**0.5 * factors[0, -2]] * count  # a slow response without dead time, until an input is searched
    delays = [0] * count
    for _ in range(10):  # 2 or 3 passes are usual; an input that one of them leaves undetermined may go to and fro
        before = delays.copy()
        for i in range(count):
            delays[i], priors[i] = _best_response(gram, moments, priors, i, factors)
        if delays == before:
            break
    return tuple(delays)


def _regression(regressors: Array, target: Array, count: int, freedom: int) -> tuple[Array, Array]:
    """Gram matrix of the lags of the inputs, one input after the other, and their products with the output.

    The past of the output and the offset are projected out; both are over the variance of the noise.
    """
    past = regressors[:, [*range(OUTPUT_LAGS), -1]]
    lagged = regressors[:, OUTPUT_LAGS:-1].reshape(-1, LAGS, count).swapaxes(1, 2).reshape(len(target), -1)
    q, _ = np.linalg.qr(past)
    lagged, target = lagged - q @ (q.T @ lagged), target - q @ (q.T @ target)
    gram, moments = lagged.T @ lagged, lagged.T @ target
    # the lags of an input held for long are nearly dependent
    solution = np.linalg.lstsq(gram, moments, rcond=1e-11)[0]
    # with less noise than 1e-4 of the spread, differences of the likelihood are lost by rounding
    variance = max(float(target @ target - moments @ solution) / freedom, 1e-8)
    return gram / variance, moments / variance


def _response_factor(delay: int, decay: float) -> Array:
    """Factor F of the prior covariance F F' of a response, shape (lags, lags)."""
    age = np.arange(1, LAGS + 1) - delay + 1.0
    return np.where(age > 0.0, decay ** (0.5 * age), 0.0)[:, None] * (age[:, None] >= age) * (age > 0.0)


def _best_response(gram: Array, moments: Array, priors: list[Array], i: int, factors: Array) -> tuple[int, Array]:
    """Dead time of an input with the largest marginal likelihood, and its prior, while those of the others stay."""
    own = slice(i * LAGS, (i + 1) * LAGS)
    rest = np.delete(np.arange(len(moments)), own)
    gram_own, moments_own = gram[own, own], moments[own]
    if rest.size:
        prior = block_diag(*(prior for j, prior in enumerate(priors) if j != i))
        cross = prior.T @ gram[rest, own]
        both = np.column_stack([cross, prior.T @ moments[rest]])
        solved = np.linalg.solve(prior.T @ gram[np.ix_(rest, rest)] @ prior + np.eye(rest.size), both)
        gram_own, moments_own = gram_own - cross.T @ solved[:, :-1], moments_own - cross.T @ solved[:, -1]
    values, vectors = np.linalg.eigh(factors.swapaxes(2, 3) @ gram_own @ factors)
    values = np.maximum(values, 0.0)[..., None]
    projected = np.einsum("dakl,dak->dal", vectors, factors.swapaxes(2, 3) @ moments_own)[..., None] ** 2
    likelihood = np.sum(SIZES * projected / (1.0 + SIZES * values) - np.log1p(SIZES * values), axis=2)
    by_delay = np.max(likelihood, axis=(1, 2))
    if np.count_nonzero(by_delay > np.max(by_delay) - UNDETERMINED) > LONGEST // 2:
        likelihood = likelihood[:1]
    delay, decay, size = np.unravel_index(np.argmax(likelihood), likelihood.shape)
    return int(delay) + 1, np.sqrt(SIZES[size]) * factors[delay, decay]
