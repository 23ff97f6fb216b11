"""Search for what a filter should estimate beside the states of the equations, from a training.

- Where the rows say that the plant is not quite the equations, or leave open how it follows a move of an input, its
  constants are uncertain (`kalman.uncertain_model`), and so are predictions until rows have taught them.
- Where the innovations are coloured even so, the plant has disturbances that wander, or its sensors noise with memory.

A plant that equals the equations, and that the training has moved enough, needs neither.
"""

from collections.abc import Sequence
from math import nan
from typing import NamedTuple

import numpy as np

from monitor_node.baseline.outlier_blocks import screen_baseline
from monitor_node.baseline.process_reference import fit_training_noise, output_indices
from monitor_node.baseline.references import GATE
from reactorwatch.arrays import Array
from reactorwatch.diagnosis.whiteness import minus_log10_p
from reactorwatch.kalman.ekf import Filter, FilterState
from reactorwatch.kalman.filter_record import FilterRecord
from reactorwatch.kalman.innovations import FilterResult
from reactorwatch.kalman.noise_estimation import NoiseFit
from reactorwatch.kalman.uncertain_model import (
    CONSTANT,
    NOISE,
    WANDER,
    is_disturbance,
    learned_parameters,
    select_effects,
    widen_model,
)
from reactorwatch.process.model import ProcessModel

LEAST_ROWS = 100
"""Number of values of each output below which nothing is sought."""

LEAST_GAIN = 8.0
"""Gain of log likelihood beyond which something is taken for a part of the plant."""

COLOURED = 3.0
"""Minus the decimal logarithm of the p-value beyond which innovations are not white, and disturbances are sought."""

MOST_DISTURBANCES = 2

MOVE_ROWS = 60
"""Number of rows after a move of an input that are predicted."""

SMALLEST_SD = 1e-6
"""Least standard deviation of a sensor."""

UNCERTAIN = 1.25
"""Ratio of standard deviations after a move, uncertain to certain constants, beyond which the training leaves open how
the plant follows."""


class Uncertain(NamedTuple):
    """Additional states of a filter.

    Attributes:
        names: texts of the states, see `kalman.uncertain_model`.
        learned: values of their `learned_parameters`.
    """

    names: tuple[str, ...] = ()
    learned: tuple[float, ...] = ()

    def add_disturbances(self, model: ProcessModel) -> ProcessModel:
        """Add the disturbances and the coloured noise to a model, not the constants."""
        return widen_model(model, tuple(filter(is_disturbance, self.names)), self.learned)


def find_uncertain(
    model: ProcessModel, outputs: tuple[str, ...], time_min: Array, inputs: Array, measured: Array
) -> Uncertain:
    """Find additional states that a filter of the model needs; empty: none.

    Args:
        model: equations of the plant.
        outputs: names of the outputs.
        time_min: times of the training in minutes, shape (n,).
        inputs: input values, shape (n, inputs).
        measured: output values, shape (n, outputs); NaN if missing or left out.
    """
    if np.min(np.count_nonzero(np.isfinite(measured), axis=0), initial=LEAST_ROWS) < LEAST_ROWS:
        return Uncertain()
    rows = _Rows(model, outputs, time_min, inputs, measured)
    plain = rows.fit(())
    if rows.drop_disturbances(plain):
        plain = rows.fit(())
    x = np.nanmedian(rows.filter(plain).x, axis=0)
    constants = tuple(f"{CONSTANT} {name}" for name in select_effects(model, x, np.nanmedian(inputs, axis=0)))
    best = rows.fit(constants)
    candidates = [f"{WANDER} {item.name}" for item in model.states if item.name not in model.at_rest]
    candidates += [f"{NOISE} {name}" for name in outputs]
    while len(best.uncertain) < len(constants) + MOST_DISTURBANCES and rows.are_coloured(best):
        fits = (rows.fit((*best.uncertain, item)) for item in candidates if item not in best.uncertain)
        found = min(fits, key=lambda item: item.noise.loss)
        if found.noise.loss > best.noise.loss - LEAST_GAIN:
            break
        best = found
    if best.uncertain != constants or plain.noise.loss - best.noise.loss > LEAST_GAIN:
        learned = (best.noise.parameters[name] for name in learned_parameters(best.uncertain))
        return Uncertain(best.uncertain, tuple(learned))
    certain, uncertain = rows.sds_after_moves(plain), rows.sds_after_moves(best)
    return Uncertain(constants) if np.any(uncertain > UNCERTAIN * certain) else Uncertain()


def describe_uncertain(uncertain: Sequence[str]) -> str:
    """Describe the additional states of a filter in words."""
    parts = {
        WANDER: [item.split(" ", 1)[1] for item in uncertain if item.startswith(f"{WANDER} ")],
        NOISE: [item.split(" ", 1)[1] for item in uncertain if item.startswith(f"{NOISE} ")],
    }
    words = [f"a disturbance of the balance of {name} wanders" for name in parts[WANDER]]
    words += [f"the noise of {name} has memory" for name in parts[NOISE]]
    if any(not is_disturbance(item) for item in uncertain):
        words.append("limits allow for what the training leaves open of the constants")
    return ", ".join(words)


class _Fit(NamedTuple):
    """Noise of the model with some uncertain parts, and its filter."""

    uncertain: tuple[str, ...]
    noise: NoiseFit
    filter: Filter


class _Rows:
    """Rows of a training; arguments as for `find_uncertain`."""

    def __init__(
        self, model: ProcessModel, outputs: tuple[str, ...], time_min: Array, inputs: Array, measured: Array
    ) -> None:
        self._model, self._outputs = model, outputs
        self._time_min, self._inputs, self._measured = time_min, inputs, measured

    def fit(self, uncertain: tuple[str, ...]) -> _Fit:
        """Fit the noise of the model with uncertain parts."""
        model, smallest = self._model, [SMALLEST_SD] * len(self._outputs)
        rows = (self._time_min, self._inputs, self._measured)
        found = fit_training_noise(model, self._outputs, *rows, smallest, uncertain)
        return _Fit(uncertain, found, Filter(widen_model(model, uncertain), found.levels, found.parameters))

    def drop_disturbances(self, item: _Fit) -> bool:
        """Leave out disturbed intervals and outliers, as a training does; returns true if there are any."""
        run, indices = self.filter(item), output_indices(self._model, self._outputs)
        screenings = [screen_baseline(column) for column in (run.residual / run.sd)[:, indices].T]
        if any(item.refused for item in screenings):
            return False
        usable = np.column_stack([item.usable for item in screenings]) | ~np.isfinite(run.residual[:, indices])
        self._measured = np.where(usable, self._measured, nan)
        return not usable.all()

    def filter(self, item: _Fit) -> FilterResult:
        """Filter the rows; the filter then stands at the last."""
        columns = np.full((self._time_min.size, len(self._model.outputs)), nan)
        columns[:, output_indices(self._model, self._outputs)] = self._measured
        return item.filter.run(FilterRecord(self._time_min, self._inputs, columns, GATE))

    def are_coloured(self, item: _Fit) -> bool:
        """True if the innovations are not white."""
        w = np.where(item.noise.w != 0.0, item.noise.w, nan)
        return bool(np.max(minus_log10_p(w, self._inputs[len(self._inputs) - len(w) :])) >= COLOURED)

    def sds_after_moves(self, item: _Fit) -> Array:
        """Standard deviations of predictions after a move of each input up and down, shape (moves, rows, n_y)."""
        self.filter(item)
        start, middle = item.filter.state, np.nanmedian(self._inputs, axis=0)
        period_min = float(np.median(np.diff(self._time_min)))
        result = []
        for index, variable in enumerate(self._model.inputs):
            for step in (-variable.scale, variable.scale):
                inputs = middle.copy()
                inputs[index] = min(max(middle[index] + step, variable.lower), variable.upper)
                result.append(_sds_at(item.filter, start, inputs.tolist(), period_min))
        return np.array(result)


def _sds_at(kalman: Filter, start: FilterState, inputs: list[float], period_min: float) -> Array:
    """Standard deviations of the predictions of `MOVE_ROWS` rows with these inputs, shape (rows, n_y)."""
    if start.time_min is None:
        return np.full((MOVE_ROWS, len(kalman.model.outputs)), nan)
    times = [start.time_min + period_min * (row + 1) for row in range(MOVE_ROWS)]
    kalman.state, nothing = start, [nan] * len(kalman.model.outputs)
    expected = [kalman.update(time, inputs, nothing).prediction for time in times]
    kalman.state = start
    return np.array([kalman.update(time, inputs, values).sd for time, values in zip(times, expected, strict=True)])
