"""Dead time of each input, from a record.

The output is regressed on its own past and on many lags of all inputs together: each input's dead time is the number of
its first lags that can go, coordinate by coordinate, at the smallest N ln(S/N) + p ln N, with S the sum of squares of
the prediction error and p the number of parameters (Schwarz, Ann. Statist. 6 (1978) 461). All inputs at once, since
with feedback, or with inputs that move together, the correlation of one input with the output misleads. Many lags of
each, since a short model of inputs with different poles makes up for its error by a wrong dead time.
"""

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.data import Dataset, rows_of
from reactorwatch.identification.structure import Delay, Structure

LONGEST = 25  # rows; the studied dead times end at 20, with 5 to spare
# Noise of measurement makes the equation of the output long: of 240 inputs of random plants, 4 lags missed 5 by more
# than a row, 15 missed 4 and 30 missed 3, which such a number does not tell apart: what a lag more costs is time.
OUTPUT_LAGS = 15


def resolve_delay(delay: int | str | dict[str, int], data: Dataset) -> Delay:
    """Delay of a structure as it was asked for: a number, `auto`, or one by the name of each input.

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


def find_dead_times(data: Dataset) -> tuple[int, ...]:
    """Dead time of each input in rows, from 1 to 25.

    Raises:
        InputError: too few complete rows for the regression.
    """
    count = data.inputs.shape[1]
    lags = LONGEST + 10  # the response after the longest dead time, whose rest the output's past describes
    structure = Structure(OUTPUT_LAGS, lags, 1, count)
    rows = rows_of(structure, *data.arrays)
    regressors, target = rows.regressors, rows.outputs[:, 0]
    if len(target) <= 2 * structure.parameters:
        raise UnfitRecordError(
            f"the search of dead times needs more than {2 * structure.parameters} complete rows in succession, "
            f"got {len(target)}: record for longer, or give --delay"
        )
    regressors = regressors - regressors.mean(axis=0)
    regressors[:, -1] = 1.0
    size = np.linalg.norm(regressors, axis=0)
    regressors, target = regressors / np.where(size > 0.0, size, 1.0), target - target.mean()
    # an input held for long has nearly dependent lags: a ridge of rounding's size
    gram, moments = regressors.T @ regressors + 1e-11 * np.eye(size.size), regressors.T @ target
    total = float(target @ target)

    def criterion(delays: NDArray[np.int64]) -> float:
        of_inputs = np.arange(1, lags + 1)[:, None] >= delays
        kept = np.concatenate([np.ones(OUTPUT_LAGS, bool), of_inputs.ravel(), [True]])
        squares = total - moments[kept] @ np.linalg.solve(gram[np.ix_(kept, kept)], moments[kept])
        return float(target.size * np.log(max(squares, 1e-14 * total)) + kept.sum() * np.log(target.size))

    delays, before = np.ones(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    while not np.array_equal(delays, before):  # each pass lowers the criterion, so it ends
        before = delays.copy()
        for i in range(count):
            others = np.arange(count) != i
            tried: list[NDArray[np.int64]] = [np.where(others, delays, delay) for delay in range(1, LONGEST + 1)]
            delays = min(tried, key=criterion)
    return tuple(int(delay) for delay in delays)
