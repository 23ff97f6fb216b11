"""The filter of a model with some effects in it, whose sizes are signals."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.diagnosis.fitting.augmented_model import SizedModel, with_size_inputs
from reactorwatch.diagnosis.fitting.colored_noise import Noise, first_rate_sd, learned, with_wandering
from reactorwatch.diagnosis.fitting.measurement_delay import Moved, gathered, moved
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.run import Run, doubt_of
from reactorwatch.kalman.batch_runner import run_together
from reactorwatch.kalman.ekf import Filter, FilterState, NoiseLevels
from reactorwatch.kalman.error_dynamics import ErrorDynamics, ErrorLinearization
from reactorwatch.kalman.filter_record import FilterRecord
from reactorwatch.kalman.innovations import FilterResult
from reactorwatch.kalman.noise_estimation import estimate_noise_and_parameters
from reactorwatch.kalman.resampling import ResampledRecord, insert_rows
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

HUBER = 4.0
"""Standard deviations beyond which an innovation counts no more than in proportion."""

LOST = 100.0
"""Standard deviations that a value counts as off where the filter has lost the plant."""

_CLUELESS = 1e6
"""Standard deviations of a sensor: a filter that is less sure of its prediction has lost the plant."""


class Known(NamedTuple):
    """A run of the filter that begins as another one does.

    Attributes:
        found: it.
        rows: how many rows are the same.
    """

    found: FilterResult
    rows: int


class Followed(NamedTuple):
    """What a filter makes of a run.

    Attributes:
        loss: minus the log likelihood, up to a constant that all share.
        w: whitened innovations, shape (rows, n_y); NaN where nothing was measured.
        found: the filter's run.
    """

    loss: float
    w: Array
    found: FilterResult


class Sized:
    """The filter of a model in which the sizes of some effects are inputs.

    A sensor that is late is left out of the filter's model: its values are moved (see `measurement_delay`).

    Args:
        model: of the plant.
        effects: that are in it; at most one makes an output late.
        noise: of the plant and its sensors.
        period_min: usual distance of rows.

    Attributes:
        effects: as given.
        late: place of the effect that makes an output late; None: no such.
    """

    def __init__(self, model: ProcessModel, effects: Sequence[Effect], noise: Noise, period_min: float = 0.1) -> None:
        self.effects = tuple(effects)
        places = [place for place, effect in enumerate(self.effects) if effect.delays_output is not None]
        self.late = places[0] if places else None
        self._plant, self._noise, self._period_min = model, noise, period_min
        sized = with_size_inputs(model, tuple(item for item in self.effects if item.delays_output is None))
        if noise.wandering:
            sized = replace(sized, model=with_wandering(sized.model, noise.wandering, period_min))
        self._filtered = sized
        self._filters = [Filter(self.model, self._levels_of(noise))]  # twins, as many as went at once so far
        self._errors = self._filtered.errors.with_noise(self.levels)
        self.noise = noise

    @property
    def model(self) -> ProcessModel:
        """That the filter has."""
        return self._filtered.model

    @property
    def own_states(self) -> int:
        """How many states the plant has that are no memory; they are the first."""
        return sum(state.name not in self._plant.at_rest for state in self._plant.states)

    @property
    def is_plain(self) -> bool:
        """Whether the filter has neither a late output nor sensors whose noise remembers."""
        return self.late is None and not self._noise.wandering

    @cached_property
    def whole(self) -> SizedModel:
        """With all effects in it, for free runs."""
        return with_size_inputs(self._plant, self.effects)

    @property
    def noise(self) -> Noise:
        """Of the plant and its sensors; the same sensors' noise remembers all the time."""
        return self._noise

    @noise.setter
    def noise(self, noise: Noise) -> None:
        self._noise, levels = noise, self._levels_of(noise)
        for item in self._filters:
            item.noise = levels
            item.set_parameters(noise.times)
        self._errors.noise, self._errors.changes = levels, noise.times

    @property
    def levels(self) -> NoiseLevels:
        """The noise as the filter has it, of all its states."""
        return self._filters[0].noise

    def size_symbols(self, effect: Effect) -> tuple[ca.SX, ca.SX] | None:
        """The inputs that are the size of an effect, as balances and outputs have it; None if it has none."""
        names = [item for item in self.effects if item.delays_output is None]
        if effect not in names:
            return None
        place = names.index(effect)
        return self._filtered.rate_symbols[place], self._filtered.output_symbols[place]

    def moves_clock(self, place: int) -> bool:
        """Whether one of the effects does, see `input_timing`."""
        late = self.late
        return place != late and self._filtered.moves_clock[place - (late is not None and late < place)]

    def inputs(self, run: Run, signals: Sequence[Signal]) -> Array:
        """Those of the filter: with the sizes beside them, shape (rows, n_u + 2 effects)."""
        prompt = [item for place, item in enumerate(signals) if place != self.late]
        return self._filtered.inputs(run.time_min, run.known_inputs, prompt)

    def follow(self, run: Run, signals: Sequence[Signal]) -> Followed:
        """What the filter makes of a run with these deviations."""
        return self.follow_all(run, [signals])[0]

    def follow_all(
        self, run: Run, several: Sequence[Sequence[Signal]], begun: Sequence[Known | None] | None = None
    ) -> list[Followed]:
        """What filters make of a run, each with other deviations; a few of them take little longer than one.

        Args:
            run: the record.
            several: of each filter the deviations.
            begun: of each, a run whose first rows are those of its own; None: none is known.
        """
        laid = [self._laid_out(run, signals) for signals in several]
        # Where a sensor is late, a known run is not one of the rows that the filter takes.
        known = [None] * len(laid) if begun is None or self.late is not None else begun
        found = self._filtered_rows([rows for rows, _ in laid], known)
        return [self._judged(run, by, item) for (_, by), item in zip(laid, found, strict=True)]

    def _judged(self, run: Run, by: Moved | None, found: FilterResult) -> Followed:
        measured, unseen, least = run.measured, np.zeros(run.measured.shape, dtype=np.bool_), self.noise.measurement_sd
        if by is not None and self.late is not None:
            output = self._output(self.late)
            found = gathered(found, by, output)
            # What was true before the beginning counts as expected: a longer delay must neither gain nor lose by it.
            unseen[:, output], measured = by.before & np.isfinite(measured[:, output]), measured.copy()
            measured[by.before, output] = np.nan
        begins = np.array([int(np.argmax(np.any(np.isfinite(measured), axis=1))), *run.breaks], dtype=np.intp)
        unseen[begins] = False
        loss, w = _judged(measured, unseen, begins, found.normalized, found.conditional_sd, np.array(least))
        return Followed(float(loss), w, found)

    def _filtered_rows(self, several: Sequence[ResampledRecord], begun: Sequence[Known | None]) -> list[FilterResult]:
        """The filters' runs over the rows of the record; of rows that are known, nothing is worked out again."""
        found: list[FilterResult] = []
        for begin in range(0, len(several), LANES):
            part = several[begin : begin + LANES]
            found += self._lanes(part, begun[begin : begin + LANES])
        return found

    def _lanes(self, several: Sequence[ResampledRecord], begun: Sequence[Known | None]) -> list[FilterResult]:
        """As many at once as there are lanes, so all from the same row on."""
        first = min(_rows_of(known, rows) for known, rows in zip(begun, several, strict=True))
        if first == several[0].time_min.size:
            return [known.found for known in begun if known is not None]
        while len(self._filters) < len(several):
            self._filters.append(self._filters[0].clone())
        runs = []
        for filtering, (time_min, inputs, measured, uncertainty, _), known in zip(
            self._filters, several, begun, strict=False
        ):
            rest, start = slice(first, None), None
            if known is not None and first:
                x, P = known.found.x[first - 1].tolist(), known.found.P[first - 1].ravel().tolist()
                start = FilterState(float(time_min[first - 1]), tuple(inputs[first - 1].tolist()), tuple(x), tuple(P))
            later = None if uncertainty is None else uncertainty.select(rest)
            record = FilterRecord.of(time_min[rest], inputs[rest], measured[rest], uncertainty=later)
            runs.append(filtering.run_batched(record, start))
        found = []
        for rows, known, new in zip(several, begun, run_together(runs), strict=True):
            if known is None or not first:
                found.append(rows.at_original_rows(new))
                continue
            both = zip(known.found, new, strict=True)
            found.append(FilterResult(*(np.concatenate([before[:first], more]) for before, more in both)))
        return found

    def tuned(
        self, run: Run, signals: Sequence[Signal], smallest_sd: Sequence[float], nearby: Sequence[Noise] = ()
    ) -> Noise:
        """The noise under which the run is likeliest with these deviations; the search may begin near one of some."""
        rows, _ = self._laid_out(run, signals)
        times = self._noise.times
        # It begins anew with a short memory: a model that lacks something makes it seem long, and there it would stay.
        first_sd = {
            f"{item.output}.noise": first_rate_sd(item.scale, self._period_min) for item in self._noise.wandering
        }
        found, times = estimate_noise_and_parameters(
            self.model,
            rows.time_min,
            rows.inputs,
            rows.measured,
            smallest_sd,
            tuple(times),
            first_sd,
            rows.uncertainty,
            [self._levels_of(item) for item in nearby if not item.wandering],
            lacking=True,
        )
        of_sensors = len(found.process_sd) - len(times)
        wandering = learned(self._noise.wandering, found.process_sd[of_sensors:], times, self._period_min)
        return Noise(found.measurement_sd, found.process_sd[: len(self._plant.states)], wandering)

    def ways(self, run: Run, signals: Sequence[Signal], found: FilterResult) -> ErrorDynamics:
        """The equations of the filter's errors about its run; from the second row on, the first that it predicts."""
        return ways_between(self._errors, run, self.inputs(run, signals), found, self.used(run))

    def used(self, run: Run) -> NDArray[np.bool_]:
        """Which values correct the filter in their own row, shape (rows, n_y); those of a late sensor do it before."""
        found = np.isfinite(run.measured)
        if self.late is not None:
            found[:, self._output(self.late)] = False
        return found

    def _laid_out(self, run: Run, signals: Sequence[Signal]) -> tuple[ResampledRecord, Moved | None]:
        """The rows that the filter takes; and, if an output is late, where its values went."""
        inputs = self.inputs(run, signals)
        if self.late is None:
            return insert_rows(run.time_min, inputs, run.measured, doubt_of(run, inputs)), None
        by = self._moved(run, inputs, signals, self.late)
        return insert_rows(by.run.time_min, by.run.inputs, by.run.measured, by.uncertainty), by

    def _moved(self, run: Run, inputs: Array, signals: Sequence[Signal], late: int) -> Moved:
        held: NDArray[np.bool_] = np.ones(inputs.shape[1], dtype=bool)
        held[run.inputs.shape[1] + 1 :: 2] = False  # what the outputs show
        return moved(run, inputs, held, self._output(late), signals[late].at_row)

    def _output(self, late: int) -> int:
        return self._plant.output_names.index(str(self.effects[late].delays_output))

    def _levels_of(self, noise: Noise) -> NoiseLevels:
        """States that an effect brings have none of their own; those of the sensors come last."""
        of_sensors = tuple(item.rate_sd for item in noise.wandering)
        more = len(self.model.states) - len(noise.process_sd) - len(of_sensors)
        return NoiseLevels(noise.measurement_sd, (*noise.process_sd, *(0.0,) * more, *of_sensors))


def ways_between(
    errors: ErrorLinearization, run: Run, inputs: Array, found: FilterResult, used: NDArray[np.bool_]
) -> ErrorDynamics:
    """The equations of a filter's errors about its run, from the second row on, the first that it predicts."""
    began = np.all(np.isnan(found.prediction), axis=1)
    # What inputs did before a break nobody knows, but in the row itself they were measured, and outputs may show them.
    inputs = np.column_stack([run.inputs, inputs[:, run.inputs.shape[1] :]])
    uncertainty, later = doubt_of(run, inputs), slice(1, None)
    return errors.dynamics(
        run.time_min[later],
        inputs[later],
        found.x[later],
        found.P[later],
        found.residual[later],
        used[later],
        began[later],
        None if uncertainty is None else uncertainty.select(later),
    )


def _rows_of(known: Known | None, rows: ResampledRecord) -> int:
    """How many rows of a known run can stand for those of another one, that goes on from the last of them."""
    if known is None or rows.original_index.size != rows.time_min.size:
        return 0
    last = known.rows - 1
    if last < 0 or not np.all(np.isfinite(known.found.x[last])) or not np.all(np.isfinite(rows.inputs[last])):
        return 0
    return known.rows


def clipped(w: Array) -> Array:
    """Whitened innovations without what is missing and what is far off."""
    return np.asarray(np.clip(np.nan_to_num(w), -HUBER, HUBER))


@jit
def _judged(
    measured: Array, unseen: NDArray[np.bool_], begins: NDArray[np.intp], whitened: Array, sd: Array, least: Array
) -> tuple[float, Array]:
    """Loss and whitened innovations, in one pass: it is done as often as a filter runs."""
    w = np.full(whitened.shape, np.nan)
    begun = np.zeros(whitened.shape[0], dtype=np.bool_)
    begun[begins] = True
    losses = spread = 0.0
    for row in range(whitened.shape[0]):
        for output in range(whitened.shape[1]):
            if np.isfinite(measured[row, output]) and not begun[row]:
                # Where it had to begin anew it says nothing of what was measured, and did not expect it at all.
                value, of_value = whitened[row, output], sd[row, output]
                if np.isfinite(value) and 0.0 < of_value < _CLUELESS * least[output]:
                    spread += np.log(of_value)
                else:
                    value = LOST
                w[row, output], size = value, abs(value)
                losses += 0.5 * size * size if size < HUBER else HUBER * (size - 0.5 * HUBER)
            elif unseen[row, output]:
                spread += np.log(least[output])
    return losses + spread, w


def loss_of(w: Array) -> float:
    """Of whitened innovations, without what they were divided by."""
    return float(np.sum(row_losses(w)))


def row_losses(w: Array) -> Array:
    """Likewise, of each row, shape (rows,)."""
    size = np.abs(np.nan_to_num(w))
    return np.asarray(np.sum(np.where(size < HUBER, 0.5 * size**2, HUBER * (size - 0.5 * HUBER)), axis=1))
