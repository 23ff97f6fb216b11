"""Gain on rows that were not fitted.

Every `EVERY`-th block of `BLOCK_MIN`, or less in a short record, is held out. The best hypothesis is fitted again
without the measurements there. Then both models are simulated through the whole record, from the filter's state after
`OBSERVED_ROWS`, driven by the inputs alone. Blocks are used instead of the end of the record because otherwise a late
deviation could not be both learned and tested.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.parameter_priors import offset_changes
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis
from reactorwatch.kalman.batch import FilterResult
from reactorwatch.process.simulate import SimulationError, Simulator

EVERY, BLOCK_MIN, FEWEST_BLOCKS = 4, 10.0, 7.5
"""Blocks are shorter in a record with fewer of them; the second held-out block then ends before the record."""

OBSERVED_ROWS = 100
WAKE_ROWS = 30
"""Rows that are not evaluated after a gap in the inputs, because the plant was driven by others."""

FEWEST_ROWS = 100
"""Smallest number of rows of a holdout; below it, those after gaps are evaluated, too."""


NEARLY = 1.15
"""Ratio to the noise: a simulation with a smaller error explains what matters, even if its residual is not white."""


class Errors(NamedTuple):
    """Root mean square errors on held-out rows.

    Attributes:
        simulation: error of the simulation, shape (n_y,); NaN where it diverged.
        one_step: error of the one-step-ahead predictions, shape (n_y,).
        values: mask of the values that were evaluated, shape (rows, n_y).
    """

    simulation: Array
    one_step: Array
    values: NDArray[np.bool_]


def blocks_of(run: Run, time_min: Array) -> Array:
    """Numbers of the blocks in which times are, from 0, shape as the times."""
    return np.asarray(np.floor((time_min - run.time_min[0]) / min(BLOCK_MIN, run.span_min / FEWEST_BLOCKS)))


def holdout_rows(run: Run, onsets_min: Sequence[float] = ()) -> Array:
    """Mask of the held-out rows, shape (rows,).

    Args:
        run: the record.
        onsets_min: onsets; their blocks are not held out, because no other block determines them.
    """
    block = blocks_of(run, run.time_min)
    result = block % EVERY == EVERY - 1
    for row in (0, *run.starts):
        result[row : row + OBSERVED_ROWS] = False
    without_onsets = result & ~np.isin(block, blocks_of(run, np.array(onsets_min)))
    result = without_onsets if np.count_nonzero(without_onsets) >= FEWEST_ROWS else result
    undisturbed = result.copy()
    for row in run.uncertain_rows:
        undisturbed[row : row + WAKE_ROWS] = False
    return np.asarray(undisturbed if np.count_nonzero(undisturbed) >= FEWEST_ROWS else result)


def evaluate_holdout(run: Run, nominal: FittedHypothesis, best: FittedHypothesis) -> tuple[Errors, Errors]:
    """Errors of the nominal model and of the best hypothesis.

    Uncertain parameters have the best hypothesis's values in both, so the difference is that of the causes alone.
    """
    hidden = holdout_rows(run, _onsets(best))
    seen = replace(run, measured=np.where(hidden[:, None], np.nan, run.measured))
    fit = best.fit
    if best is not nominal:
        fit = best.hypothesis.fit(seen, best.fit.parameters)
    elif best.hypothesis.filter.model.constant_states:
        fit = best.hypothesis.evaluate(seen, ())
    offsets = best.hypothesis.offsets(fit)
    before = _errors(run, hidden, nominal.hypothesis.filter, (), offsets)
    if best is nominal:
        return before, before
    return before, _errors(run, hidden, best.hypothesis.filter, best.hypothesis.signals(fit), offsets)


def excess(error: Array, noise_sd: Array) -> Array:
    """Root mean square error beyond the noise, shape (n_y,)."""
    return np.asarray(np.sqrt(np.maximum(error**2 - noise_sd**2, 0.0)))


def share_of(before: Array, after: Array, noise_sd: Array) -> float:
    """Share of the squared errors beyond the noise that an explanation removes; NaN: the simulation diverged.

    Args:
        before: root mean square error of each output without the explanation, shape (n_y,).
        after: the same with it.
        noise_sd: standard deviation of each sensor's noise, shape (n_y,).
    """
    was, left = (float(np.sum((excess(item, noise_sd) / noise_sd) ** 2)) for item in (before, after))
    if not np.isfinite(left):
        return 0.0
    if not np.isfinite(was):
        return 1.0
    return min(max(1.0 - left / was, 0.0), 1.0) if was > 0.0 else 0.0


def is_near_noise(errors: Errors, noise_sd: Array) -> bool:
    """Return true if the simulation's errors on held-out rows are close to the sensors' noise, shape (n_y,)."""
    return bool(np.all(errors.simulation < NEARLY * noise_sd))


def _onsets(best: FittedHypothesis) -> list[float]:
    parameters = (part.profile.profile_values(part.parameters) for part in best.parts)
    return [item["onset"] for item in parameters if "onset" in item]


def simulate_outputs(
    run: Run,
    ekf: FaultFilter,
    signals: Sequence[Signal],
    offsets: Mapping[str, float],
    result: FilterResult | None = None,
) -> Array:
    """Simulated outputs, shape (rows, n_y); NaN where the simulation diverged.

    The first rows, and those after a restart of the plant, are the filter's predictions.

    Args:
        run: the record.
        ekf: filter of the model.
        signals: deviations in it.
        offsets: offsets of uncertain parameters, by name.
        result: run of the filter, if it is known.
    """
    result = ekf.evaluate(run, signals).innovations if result is None else result
    outputs = np.array(result.prediction)
    whole = ekf.full_model
    inputs = whole.inputs(run.time_min, run.inputs, signals)
    run_freely = Simulator(whole.model).run
    for begin, end in pairwise((0, *run.starts, run.time_min.size)):
        first = max(begin, min(begin + OBSERVED_ROWS, end - 2))
        while first < end - 2 and not np.all(np.isfinite(result.x[first])):
            first += 1
        start = result.x[first][: ekf.n_plant_states]  # internal states of effects are fast and start at 0
        if run.starts and (end - first < 2 or not np.all(np.isfinite(start))):
            continue  # so short a run keeps the filter's predictions
        try:
            time_min = run.time_min[first:end]
            outputs[first:end] = run_freely(time_min, inputs[first:end], start, offset_changes(offsets)).outputs
        except SimulationError:
            outputs[first:end] = np.nan
    return outputs


def _errors(
    run: Run, hidden: Array, ekf: FaultFilter, signals: Sequence[Signal], offsets: Mapping[str, float]
) -> Errors:
    result = ekf.evaluate(run, signals).innovations
    free = simulate_outputs(run, ekf, signals, offsets, result)
    with np.errstate(invalid="ignore"):
        values = hidden[:, None] & np.isfinite(run.measured)
        return Errors(rms((run.measured - free)[hidden]), rms(result.residual[hidden]), values)


def rms(values: Array) -> Array:
    """Root mean square of the finite values of each column; NaN if there is none."""
    finite = np.isfinite(values)
    squares = np.sum(np.where(finite, values, 0.0) ** 2, axis=0)
    return np.where(finite.any(axis=0), np.sqrt(squares / np.maximum(finite.sum(axis=0), 1)), np.nan)
