"""The gain, measured on rows that the fit did not see.

Every `EVERY`-th block of `BLOCK_MIN` is held out, or of less in a short record: the numbers of the best hypothesis are
fitted again without what was measured there, and then both models run freely through the whole record, from where the
filter has found them after `OBSERVED_ROWS`, driven by the inputs alone. Blocks, and not the end of the record, because
a deviation that sets in late would otherwise never be both learned and tested.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.fault_filter import Sized
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.parameter_priors import beginning_with
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import Explained
from reactorwatch.kalman.innovations import FilterResult
from reactorwatch.process.integrate import SimulationError
from reactorwatch.process.simulate import Simulator

EVERY, BLOCK_MIN, FEWEST_BLOCKS = 4, 10.0, 7.5
"""Blocks are shorter in a record that has fewer of them; the second one held out is then over before its end."""

OBSERVED_ROWS = 100
WAKE_ROWS = 30
"""After a break in what is known of the inputs, so many rows are not judged: the plant itself was driven otherwise."""

FEWEST_ROWS = 100
"""Where that leaves less, they are."""


class Errors(NamedTuple):
    """Root mean square errors on what was held out.

    Attributes:
        free: of a free run, shape (n_y,); NaN where it came to an end.
        one_step: of the filter's predictions, likewise.
        values: which values they are of, shape (rows, n_y).
    """

    free: Array
    one_step: Array
    values: NDArray[np.bool_]


def held_out_rows(run: Run, onsets_min: Sequence[float] = ()) -> Array:
    """Which rows are held out, shape (rows,).

    Args:
        run: the record.
        onsets_min: when something set in: the blocks in which it did are seen, for no other tells when.
    """
    block_min = min(BLOCK_MIN, run.span_min / FEWEST_BLOCKS)
    block = np.floor((run.time_min - run.time_min[0]) / block_min)
    found = block % EVERY == EVERY - 1
    for row in (0, *run.starts):
        found[row : row + OBSERVED_ROWS] = False
    told = found & ~np.isin(block, [np.floor((onset - run.time_min[0]) / block_min) for onset in onsets_min])
    found = told if np.count_nonzero(told) >= FEWEST_ROWS else found
    calm = found.copy()
    for row in run.after_doubt:
        calm[row : row + WAKE_ROWS] = False
    return np.asarray(calm if np.count_nonzero(calm) >= FEWEST_ROWS else found)


def gained(run: Run, nominal: Explained, best: Explained) -> tuple[Errors, Errors]:
    """Errors of the nominal model and of the best hypothesis; in both uncertain parameters are as the latter has them.

    So the difference is that of the causes alone.
    """
    hidden = held_out_rows(run, _onsets(best))
    seen = replace(run, measured=np.where(hidden[:, None], np.nan, run.measured))
    fit = best.fit
    if best is not nominal:
        fit = best.hypothesis.fit(seen, best.fit.theta)
    elif best.hypothesis.sized.model.constant_states:
        fit = best.hypothesis.at(seen, ())
    known = best.hypothesis.offsets(fit)
    before = _errors(run, hidden, nominal.hypothesis.sized, (), known)
    if best is nominal:
        return before, before
    return before, _errors(run, hidden, best.hypothesis.sized, best.hypothesis.signals(fit), known)


def _onsets(explained: Explained) -> list[float]:
    parameters = (
        course.parameters(theta)
        for course, theta in zip(explained.hypothesis.courses, explained.fit.theta, strict=True)
    )
    return [item["onset"] for item in parameters if "onset" in item]


def free_run(run: Run, sized: Sized, signals: Sequence[Signal], known: Mapping[str, float]) -> Array:
    """The outputs of a free run, shape (rows, n_y); NaN if it came to an end.

    The first rows, and those after the plant started again, are the filter's.

    Args:
        run: the record.
        sized: the model.
        signals: the deviations in it.
        known: what uncertain parameters are off by, by name.
    """
    return _freely(run, sized, signals, sized.follow(run, signals).found, known)


def _freely(
    run: Run, sized: Sized, signals: Sequence[Signal], found: FilterResult, known: Mapping[str, float]
) -> Array:
    outputs = np.array(found.prediction)
    whole = sized.whole
    inputs = whole.inputs(run.time_min, run.inputs, signals)
    run_freely = Simulator(whole.model).run
    for begin, end in pairwise((0, *run.starts, run.time_min.size)):
        first = max(begin, min(begin + OBSERVED_ROWS, end - 2))
        while first < end - 2 and not np.all(np.isfinite(found.x[first])):
            first += 1
        start = found.x[first][: sized.own_states]  # memory is short: it begins at rest
        if run.starts and (end - first < 2 or not np.all(np.isfinite(start))):
            continue  # of a run this short nothing is known but what the filter predicts
        try:
            time_min = run.time_min[first:end]
            outputs[first:end] = run_freely(time_min, inputs[first:end], start, beginning_with(known)).outputs
        except SimulationError:
            outputs[first:end] = np.nan
    return outputs


def _errors(run: Run, hidden: Array, sized: Sized, signals: Sequence[Signal], known: Mapping[str, float]) -> Errors:
    found = sized.follow(run, signals).found
    free = _freely(run, sized, signals, found, known)
    with np.errstate(invalid="ignore"):
        values = hidden[:, None] & np.isfinite(run.measured)
        return Errors(_rms((run.measured - free)[hidden]), _rms(found.residual[hidden]), values)


def _rms(values: Array) -> Array:
    known = np.isfinite(values)
    count = np.maximum(known.sum(axis=0), 1)
    return np.where(known.any(axis=0), np.sqrt(np.sum(np.where(known, values, 0.0) ** 2, axis=0) / count), np.nan)
