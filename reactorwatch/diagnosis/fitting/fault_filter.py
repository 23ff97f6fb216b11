"""EKF of a model augmented with effects whose magnitudes are input signals."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.diagnosis.fitting.augmented_model import (
    AugmentedModel,
    ShiftedRun,
    augment_model,
    restore_rows,
    shift_measurements,
)
from reactorwatch.diagnosis.fitting.colored_noise import Noise, add_colored_noise, estimate_noise
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.run import Run, input_uncertainty_of
from reactorwatch.kalman.batch import (
    FilterRecord,
    FilterResult,
    ResampledRecord,
    StepBudget,
    StepCost,
    count_pieces,
    insert_rows,
    run_together,
)
from reactorwatch.kalman.ekf import Filter, FilterState
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.error_dynamics import ErrorDynamics, ErrorLinearization
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

HUBER = 4.0
"""Standard deviations beyond which the loss of an innovation grows linearly."""

DIVERGED_RESIDUAL = 100.0
"""Standard deviations charged for a value where the filter has diverged."""

MOST_DIVERGENCES, ROWS_PER_DIVERGENCE = 30, 250
"""Divergences after which the filter of an effect is given up, and rows of a longer record that allow one more: each
restart costs as much as a hundred rows."""

_DIVERGED_SD = 1e6
"""Ratio of predicted standard deviation to sensor noise beyond which the filter has diverged."""


class SharedPrefix(NamedTuple):
    """A filter run whose first rows are the same as those of another run.

    Attributes:
        innovations: the run.
        rows: number of rows that are the same.
    """

    innovations: FilterResult
    rows: int


class FilterEvaluation(NamedTuple):
    """Innovations and loss of a filter run.

    Attributes:
        loss: negative log likelihood, up to a constant common to all hypotheses.
        w: normalised innovations, shape (rows, n_y); NaN where not measured.
        innovations: the filter run.
    """

    loss: float
    w: Array
    innovations: FilterResult


class FaultFilter:
    """EKF of a model in which the magnitudes of some effects are inputs.

    A measurement delay is not part of the filter's model: the delayed values are shifted in time (see
    `augmented_model`).

    Args:
        model: process model of the plant.
        effects: effects in the model; at most one delays an output.
        noise: noise levels of the plant and its sensors.
        period_min: median sampling period.

    Attributes:
        effects: the effects as given.
        delay_index: index of the effect that delays an output; None without one.
    """

    def __init__(self, model: ProcessModel, effects: Sequence[Effect], noise: Noise, period_min: float = 0.1) -> None:
        self.effects = tuple(effects)
        delays = (index for index, effect in enumerate(self.effects) if effect.delays_output is not None)
        self.delay_index = next(delays, None)
        self._plant, self._noise, self._period_min = model, noise, period_min
        self._changes: dict[str, float] = {}
        augmented = augment_model(model, tuple(item for item in self.effects if item.delays_output is None))
        if noise.colored:
            augmented = replace(augmented, model=add_colored_noise(augmented.model, noise.colored, period_min))
        self._augmented = augmented
        self._filters = [Filter(self.model, self._all_levels(noise))]  # twins, one for each lane used so far
        self._errors = self._augmented.errors.with_noise(self.noise_levels)
        self.noise = noise

    @property
    def model(self) -> ProcessModel:
        """Process model of the filter, with effects and coloured noise."""
        return self._augmented.model

    @property
    def n_plant_states(self) -> int:
        """Number of the plant's states that are not internal states of effects; they come first."""
        return sum(state.name not in self._plant.at_rest for state in self._plant.states)

    @property
    def is_plain(self) -> bool:
        """True if no output is delayed and no sensor noise is coloured."""
        return self.delay_index is None and not self._noise.colored

    @cached_property
    def full_model(self) -> AugmentedModel:
        """Model with all effects, delays included, for simulation."""
        return augment_model(self._plant, self.effects)

    @property
    def noise(self) -> Noise:
        """Noise levels of the plant and its sensors. A new value must have coloured noise of the same sensors."""
        return self._noise

    @noise.setter
    def noise(self, noise: Noise) -> None:
        self._noise, levels = noise, self._all_levels(noise)
        for item in self._filters:
            item.noise = levels
            item.set_parameters(noise.parameter_changes | self._changes)
        self._errors.noise, self._errors.changes = levels, noise.parameter_changes

    def set_changes(self, changes: Mapping[str, float]) -> None:
        """Set the parameters that differ from the model's values."""
        self._changes = dict(changes)
        for item in self._filters:
            item.set_parameters(self._noise.parameter_changes | self._changes)

    @property
    def noise_levels(self) -> NoiseLevels:
        """Noise levels of all of the filter's states."""
        return self._filters[0].noise

    @property
    def budget(self) -> StepBudget | None:
        """Budget of filter steps for runs and linearisations; None: they are not counted."""
        return self._filters[0].budget

    def limit(self, budget: StepBudget | None) -> None:
        """Count filter steps against a budget, and end each run where the filter diverges."""
        for item in self._filters:
            item.budget, item.stops_at_restart = budget, True

    def spend(self, steps: int) -> None:
        """Count steps against the budget, if there is one."""
        if self.budget is not None:
            self.budget.spend(steps)

    def prepare(self) -> None:
        """Compile now what the first run and the first linearisation would compile."""
        self._filters[0].prepare()
        self._errors.prepare()

    def size_symbols(self, effect: Effect) -> tuple[ca.SX, ca.SX] | None:
        """Symbols of an effect's interval and sample inputs; None if the filter's model does not have it."""
        names = [item for item in self.effects if item.delays_output is None]
        if effect not in names:
            return None
        index = names.index(effect)
        return self._augmented.interval_inputs[index], self._augmented.sample_inputs[index]

    def shifts_time(self, index: int) -> bool:
        """Return true if the effect at this index shifts the timing, see `augmented_model`."""
        late = self.delay_index
        return index != late and self._augmented.shifts_time[index - (late is not None and late < index)]

    def constant_index(self, index: int) -> int:
        """Index of an effect's first constant among the inputs of the error equations."""
        late = self.delay_index
        return self._augmented.constant_index(index - (late is not None and late < index))

    def inputs(self, run: Run, signals: Sequence[Signal]) -> Array:
        """Inputs of the filter, magnitudes and constants included, shape (rows, n_u + those)."""
        prompt = [item for index, item in enumerate(signals) if index != self.delay_index]
        return self._augmented.inputs(run.time_min, run.certain_inputs, prompt)

    def evaluate(self, run: Run, signals: Sequence[Signal]) -> FilterEvaluation:
        """Run the filter with these deviations."""
        return self.evaluate_all(run, [signals])[0]

    def evaluate_all(
        self, run: Run, several: Sequence[Sequence[Signal]], shared: Sequence[SharedPrefix | None] | None = None
    ) -> list[FilterEvaluation]:
        """Run the filter with several sets of deviations in parallel lanes, which take little longer than one.

        Args:
            run: the record.
            several: sets of deviations, one signal for each effect.
            shared: for each set, a run with the same first rows or None; None: no such runs.
        """
        laid = [self._lay_out_rows(run, signals) for signals in several]
        self.spend(sum(StepCost.EVALUATION + rows.time_min.size // 10 for rows, _ in laid))
        # With a delayed output the filter's rows depend on the delay, so no prefix is shared.
        prefixes = [None] * len(laid) if shared is None or self.delay_index is not None else shared
        innovations = self._filter_rows([rows for rows, _ in laid], prefixes)
        return [self._evaluate_rows(run, by, item) for (_, by), item in zip(laid, innovations, strict=True)]

    def _evaluate_rows(self, run: Run, by: ShiftedRun | None, innovations: FilterResult) -> FilterEvaluation:
        measured, unseen, least = run.measured, np.zeros(run.measured.shape, dtype=np.bool_), self.noise.measurement_sd
        if by is not None and self.delay_index is not None:
            output = self._output(self.delay_index)
            innovations = restore_rows(innovations, by, output)
            # Values that were true before the start count as expected, so that a longer delay neither gains nor loses.
            unseen[:, output], measured = by.before_start & np.isfinite(measured[:, output]), measured.copy()
            measured[by.before_start, output] = np.nan
        begins = np.array([int(np.argmax(np.any(np.isfinite(measured), axis=1))), *run.breaks], dtype=np.intp)
        unseen[begins] = False
        loss, w = _huber_likelihood(
            measured, unseen, begins, innovations.normalized, innovations.conditional_sd, np.array(least)
        )
        return FilterEvaluation(float(loss), w, innovations)

    def _filter_rows(
        self, several: Sequence[ResampledRecord], shared: Sequence[SharedPrefix | None]
    ) -> list[FilterResult]:
        """Filter the laid-out rows, in batches of `LANES`; rows of shared prefixes are not computed again."""
        innovations: list[FilterResult] = []
        for begin in range(0, len(several), LANES):
            part = several[begin : begin + LANES]
            innovations += self._filter_lanes(part, shared[begin : begin + LANES])
        return innovations

    def _filter_lanes(
        self, several: Sequence[ResampledRecord], shared: Sequence[SharedPrefix | None]
    ) -> list[FilterResult]:
        """Filter as many records at once as there are lanes, all from the same row on."""
        index = several[0].original_index
        same = min(_count_shared_rows(prefix, rows) for prefix, rows in zip(shared, several, strict=True))
        if same == index.size:
            return [prefix.innovations for prefix in shared if prefix is not None]
        while len(self._filters) < len(several):
            self._filters.append(self._filters[0].clone())
        last = int(index[same - 1]) if same else -1
        first = last + 1
        runs = []
        for filtering, (time_min, inputs, measured, uncertainty, _), prefix in zip(
            self._filters, several, shared, strict=False
        ):
            remaining, start = slice(first, None), None
            if prefix is not None and same:
                x, P = prefix.innovations.x[same - 1].tolist(), prefix.innovations.P[same - 1].ravel().tolist()
                start = FilterState(float(time_min[last]), tuple(inputs[last].tolist()), tuple(x), tuple(P))
            if self.effects:  # the nominal model, with which all effects are compared, always runs to the end
                filtering.most_divergences = max(MOST_DIVERGENCES, index.size // ROWS_PER_DIVERGENCE)
            later = None if uncertainty is None else uncertainty.select(remaining)
            record = FilterRecord(time_min[remaining], inputs[remaining], measured[remaining], uncertainty=later)
            runs.append(filtering.run_batched(record, start))
        innovations = []
        for rows, prefix, new in zip(several, shared, run_together(runs), strict=True):
            if prefix is None or not same:
                innovations.append(rows.at_original_rows(new))
                continue
            both = zip(prefix.innovations, new, strict=True)
            rest = index[same:] - first
            innovations.append(FilterResult(*(np.concatenate([before[:same], more[rest]]) for before, more in both)))
        return innovations

    def estimate_noise(
        self, run: Run, signals: Sequence[Signal], smallest_sd: Sequence[float], nearby: Sequence[Noise] = ()
    ) -> Noise:
        """Estimate the noise levels by maximum likelihood, given these deviations.

        `nearby` levels are further initial values.
        """
        rows, _ = self._lay_out_rows(run, signals)
        record = FilterRecord(rows.time_min, rows.inputs, rows.measured, uncertainty=rows.uncertainty)
        starts = [self._all_levels(item) for item in nearby if not item.colored]
        found = estimate_noise(self.model, record, self._noise, smallest_sd, starts, self._period_min)
        of_plant = found.process_sd[: len(self._plant.states)]
        return Noise(found.measurement_sd, of_plant, found.colored)

    def error_dynamics(self, run: Run, signals: Sequence[Signal], innovations: FilterResult) -> ErrorDynamics:
        """Error equations about a filter run, from the second row on, the first one that is predicted."""
        self.spend(StepCost.LINEARISATION + int(1.5 * np.sum(count_pieces(run.time_min))))
        return error_dynamics_between(self._errors, run, self.inputs(run, signals), innovations, self.used_values(run))

    def used_values(self, run: Run) -> NDArray[np.bool_]:
        """Mask of values that correct the filter in their own row, shape (rows, n_y).

        Delayed values correct it earlier.
        """
        used = np.isfinite(run.measured)
        if self.delay_index is not None:
            used[:, self._output(self.delay_index)] = False
        return used

    def _lay_out_rows(self, run: Run, signals: Sequence[Signal]) -> tuple[ResampledRecord, ShiftedRun | None]:
        """Rows that the filter takes and, if an output is delayed, the shifted run."""
        inputs = self.inputs(run, signals)
        if self.delay_index is None:
            return insert_rows(run.time_min, inputs, run.measured, input_uncertainty_of(run, inputs)), None
        by = self._shift_measurements(run, inputs, signals, self.delay_index)
        return insert_rows(by.run.time_min, by.run.inputs, by.run.measured, by.uncertainty), by

    def _shift_measurements(self, run: Run, inputs: Array, signals: Sequence[Signal], late: int) -> ShiftedRun:
        held: NDArray[np.bool_] = np.ones(inputs.shape[1], dtype=bool)
        first = run.inputs.shape[1]
        held[first + 1 : first + 2 * len(self._augmented.sample_inputs) : 2] = False  # sample inputs
        return shift_measurements(run, inputs, held, self._output(late), signals[late].sample_value)

    def _output(self, late: int) -> int:
        return self._plant.output_names.index(str(self.effects[late].delays_output))

    def _all_levels(self, noise: Noise) -> NoiseLevels:
        """Noise levels of all states: zero for the internal states of effects; coloured noise comes last."""
        of_sensors = tuple(item.driving_sd for item in noise.colored)
        more = len(self.model.states) - len(noise.process_sd) - len(of_sensors)
        return NoiseLevels(noise.measurement_sd, (*noise.process_sd, *(0.0,) * more, *of_sensors))


def error_dynamics_between(
    errors: ErrorLinearization, run: Run, inputs: Array, innovations: FilterResult, used: NDArray[np.bool_]
) -> ErrorDynamics:
    """Error equations about a filter run, from the second row on, the first one that is predicted."""
    began = np.all(np.isnan(innovations.prediction), axis=1)
    # Inputs before a break are unknown, but those of the row itself were measured and may act on its outputs.
    inputs = np.column_stack([run.inputs, inputs[:, run.inputs.shape[1] :]])
    uncertainty, later = input_uncertainty_of(run, inputs), slice(1, None)
    return errors.dynamics(
        run.time_min[later],
        inputs[later],
        innovations.x[later],
        innovations.P[later],
        innovations.residual[later],
        used[later],
        began[later],
        None if uncertainty is None else uncertainty.select(later),
    )


def _count_shared_rows(prefix: SharedPrefix | None, rows: ResampledRecord) -> int:
    """Number of rows that can be copied from a shared prefix; the filter resumes after the last of them."""
    if prefix is None or not prefix.rows:
        return 0
    last, resumed = prefix.rows - 1, rows.original_index[prefix.rows - 1]
    if not np.all(np.isfinite(prefix.innovations.x[last])) or not np.all(np.isfinite(rows.inputs[resumed])):
        return 0
    return prefix.rows


def huber_clip(w: Array) -> Array:
    """Clip normalised innovations to `HUBER`; missing values become 0."""
    return np.asarray(np.clip(np.nan_to_num(w), -HUBER, HUBER))


def huber_weights(w: Array) -> Array:
    """Weights with which least squares minimises the Huber loss of normalised innovations."""
    return np.asarray(HUBER / np.maximum(np.abs(w), HUBER))


@jit
def _huber_likelihood(
    measured: Array, unseen: NDArray[np.bool_], begins: NDArray[np.intp], whitened: Array, sd: Array, least: Array
) -> tuple[float, Array]:
    """Loss and normalised innovations in one pass; called for every filter run."""
    w = np.full(whitened.shape, np.nan)
    shared = np.zeros(whitened.shape[0], dtype=np.bool_)
    shared[begins] = True
    losses = spread = 0.0
    for row in range(whitened.shape[0]):
        for output in range(whitened.shape[1]):
            if np.isfinite(measured[row, output]) and not shared[row]:
                # Where the filter restarted it predicted nothing; the value counts as wholly unexpected.
                value, of_value = whitened[row, output], sd[row, output]
                if np.isfinite(value) and 0.0 < of_value < _DIVERGED_SD * least[output]:
                    spread += np.log(of_value)
                else:
                    value = DIVERGED_RESIDUAL
                w[row, output], size = value, abs(value)
                losses += 0.5 * size * size if size < HUBER else HUBER * (size - 0.5 * HUBER)
            elif unseen[row, output]:
                spread += np.log(least[output])
    return losses + spread, w


def huber_loss(w: Array) -> float:
    """Huber loss of normalised innovations, without their scale."""
    return float(np.sum(huber_row_losses(w)))


def huber_row_losses(w: Array) -> Array:
    """Huber loss of each row, shape (rows,)."""
    size = np.abs(np.nan_to_num(w))
    return np.asarray(np.sum(np.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER)), axis=1))
