"""What a row is expected to be: the reference that residuals are taken against. It is frozen when the training ends.

Two kinds. `ProcessReference` is the extended Kalman filter of the reactor's equations: it knows how the plant bends,
so a coolant flow that it has never seen is no surprise to it, and irregular rows are none either. `ArxReference` is the
identified model: it holds for any plant, but only where it was trained, so rows whose input lies outside of that
are not judged.
"""

from collections.abc import Sequence
from math import isfinite, nan
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from monitor_node.ingest.sampling import missing_rows
from reactorwatch.errors import InputError
from reactorwatch.kalman.ekf import Filter, FilterState, NoiseLevels
from reactorwatch.kalman.noise_estimation import estimate_noise
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import StoredState

Array = NDArray[np.float64]

GATE = 6.0
"""A value so many standard deviations off does not correct the filter until the next one confirms it."""

MOST_UNKNOWN = 1
"""Rows in succession whose input may be unknown; behind more, the filter begins anew."""

MARGIN = 0.1
"""Of the range of the input in training, by which it may be left on either side."""


class Expected(NamedTuple):
    """What was expected of a row before it was seen, and how sure that was.

    Attributes:
        prediction: one an output, in its unit; NaN where nothing can be said.
        sd: of the residual, in the output's unit: as far as the reference knows it, 1 if it does not.
    """

    prediction: Sequence[float]
    sd: Sequence[float]


class ProcessReferenceState(StoredState, frozen=True, tag="process"):
    """What a `ProcessReference` is and remembers.

    Attributes:
        noise: of the plant and its sensors.
        filter: what it remembers.
        last_input: the newest that was not missing.
        guessed: whether the input of the newest row that the filter took was missing.
        typical_sd: see `ProcessReference`.
        held_rows: number of rows since then, which the filter did not take.
        reach: see `input_reach`.
    """

    noise: NoiseLevels
    filter: FilterState
    last_input: float
    guessed: bool
    typical_sd: list[float]
    held_rows: int = 0
    reach: float = 0.0


class ArxReferenceState(StoredState, frozen=True, tag="arx"):
    """What an `ArxReference` is: the range of the input in which it holds."""

    low: float
    high: float


class Reference(Protocol):
    """What rows are expected by.

    Attributes:
        kind: `equations` or `arx`, as it is published.
    """

    kind: str

    def update(
        self, time_ns: int, input_value: float, values: list[float], accept: tuple[bool, ...], missing: int = 0
    ) -> Expected:
        """Take a row in.

        Args:
            time_ns: of the row.
            input_value: of the plant's input; NaN if missing.
            values: of the outputs; NaN where missing.
            accept: outputs that the reference is to follow however far off they are.
            missing: number of rows missing just before this one, whose inputs are not known.
        """

    def restart(self) -> None:
        """Begin anew with the next row: the plant's clock was set, or it was away for long."""

    @property
    def state(self) -> ProcessReferenceState | ArxReferenceState:
        """All that it is and remembers, but for its model."""


class ProcessReference:
    """The filter of the reactor's equations.

    Args:
        model: of the plant.
        outputs: the names of those that are watched, in order.
        noise: of the plant and its sensors.

    Raises:
        InputError: the model lacks an output.
    """

    kind = "equations"

    def __init__(self, model: ProcessModel, outputs: tuple[str, ...], noise: NoiseLevels) -> None:
        self.model, self.noise = model, noise
        self._filter = Filter(model, noise)
        self._places = places(model, outputs)
        self._count = len(model.outputs)
        self._accept_all = len(outputs) == self._count and self._places == list(range(self._count))
        self._last_input, self._guessed, self._held_rows = nan, False, 0
        self._reach = 0.0
        self.typical_sd = [1.0] * len(outputs)
        """Standard deviation of a residual by the filter, in the outputs' units, as it mostly was in the last `run`."""

    @classmethod
    def from_state(
        cls, state: ProcessReferenceState, model: ProcessModel, outputs: tuple[str, ...]
    ) -> "ProcessReference":
        """The one that goes on, bit for bit, where `state` was taken.

        Raises:
            ValueError: the state is of another model.
        """
        reference = cls(model, outputs, state.noise)
        if len(state.filter.inputs) not in (0, len(model.inputs)):
            raise ValueError(f"the filter's state must have {len(model.inputs)} inputs, got {state.filter.inputs}")
        reference._filter.state = state.filter
        reference._last_input, reference._guessed = state.last_input, state.guessed
        reference._held_rows, reference._reach = state.held_rows, state.reach
        reference.typical_sd = list(state.typical_sd)
        return reference

    @property
    def noise_levels(self) -> dict[str, dict[str, float]]:
        """Standard deviations by name: of each sensor in its unit, of each state in its unit per square root minute."""
        return {
            "sensors": dict(zip(self.model.output_names, self.noise.measurement_sd, strict=True)),
            "states": dict(zip((item.name for item in self.model.states), self.noise.process_sd, strict=True)),
        }

    @property
    def state(self) -> ProcessReferenceState:
        """See `Reference`."""
        return ProcessReferenceState(
            self.noise,
            self._filter.state,
            self._last_input,
            self._guessed,
            list(self.typical_sd),
            self._held_rows,
            self._reach,
        )

    def update(
        self, time_ns: int, input_value: float, values: list[float], accept: tuple[bool, ...], missing: int = 0
    ) -> Expected:
        """See `Reference`.

        An input is held until the next row. So where a row or its input is missing, nothing is predicted until the
        input shows. Behind one such row the prediction is then as uncertain as the input was: it was as before or as
        after, give or take what moves of the training that went back at once amount to.
        """
        time_min, between = time_ns / MINUTE_NS, None
        unknown = self._guessed + self._held_rows + missing
        if isfinite(input_value):
            if unknown > MOST_UNKNOWN:
                self._filter.restart()
            elif unknown:
                between = self._between(time_min, input_value)
            self._last_input, self._guessed, self._held_rows = input_value, False, 0
        elif unknown or not isfinite(self._last_input):
            self._held_rows += missing + 1
            nothing = [nan] * len(values)
            return Expected(nothing, nothing)
        else:
            self._guessed = True
        if self._accept_all:
            found = self._filter.update(
                time_min, (self._last_input,), values, gate=GATE, accept=accept, between=between
            )
            return Expected(found.prediction, found.sd)
        measured, followed = [nan] * self._count, [False] * self._count
        for place, value, follow in zip(self._places, values, accept, strict=True):
            measured[place], followed[place] = value, follow
        found = self._filter.update(
            time_min, (self._last_input,), measured, gate=GATE, accept=tuple(followed), between=between
        )
        return Expected(
            [found.prediction[place] for place in self._places], [found.sd[place] for place in self._places]
        )

    def _between(self, time_min: float, input_value: float) -> tuple[float, list[tuple[float]]] | None:
        """From when on the input is not known, and what it may have been: one row is missing, or its input.

        None: it was as before and after, or the filter begins with this row, so that nothing before it counts.
        """
        before_min, ends = self._filter.state.time_min, {self._last_input, input_value}
        if before_min is None or (len(ends) == 1 and not self._reach):
            return None
        lower, upper = self.model.inputs[0].lower, self.model.inputs[0].upper
        by = (-self._reach, self._reach) if self._reach else (0.0,)
        inputs = [(min(max(end + reach, lower), upper),) for end in sorted(ends) for reach in by]
        return (before_min if self._guessed else 0.5 * (before_min + time_min)), inputs

    def restart(self) -> None:
        """See `Reference`."""
        self._filter.restart()
        self._guessed, self._held_rows = False, 0

    def run(self, time_min: Array, inputs: Array, measured: Array) -> tuple[Array, Array]:
        """Take many rows in; returns the residuals, and the same in standard deviations, each of shape (n, outputs).

        How far the input goes and comes back at once is learned. Behind missing rows the filter begins anew.

        Args:
            time_min: shape (n,).
            inputs: shape (n,).
            measured: shape (n, outputs).
        """
        self._reach = input_reach(time_min, inputs)
        if self._accept_all and np.isfinite(inputs).all():
            times = np.round(time_min * MINUTE_NS) / MINUTE_NS
            found = self._filter.run(times, _until_missing(time_min, inputs), measured, gate=GATE)
            z = found.residual / found.sd
            if not np.any(np.abs(z) > GATE):  # no value was to be followed or not because of the one before
                self._last_input, self._guessed, self._held_rows = float(inputs[-1]), False, 0
                self.typical_sd = _typical(found.sd)
                return found.residual, z
            self._filter.restart()
        residuals, z = np.full(measured.shape, np.nan), np.full(measured.shape, np.nan)
        sds = np.full(measured.shape, np.nan)
        accept, is_behind = (False,) * measured.shape[1], _are_behind_missing(time_min).tolist()
        for row, values in enumerate(measured.tolist()):
            if is_behind[row]:
                self.restart()
            expected = self.update(round(time_min[row] * MINUTE_NS), float(inputs[row]), values, accept)
            off = [value - prediction for value, prediction in zip(values, expected.prediction, strict=True)]
            residuals[row], sds[row] = off, expected.sd
            z[row] = [size / sd for size, sd in zip(off, expected.sd, strict=True)]
            accept = tuple(abs(size) > GATE for size in z[row].tolist())
        self.typical_sd = _typical(sds)
        return residuals, z


def _typical(sds: Array) -> list[float]:
    """What each column mostly is; 1 where it is not known."""
    known = [column[np.isfinite(column)] for column in sds.T]
    return [float(np.median(column)) if column.size else 1.0 for column in known]


class ArxReference:
    """Identified models, one an output; their predictions are handed in.

    Args:
        inputs: that were seen in training, shape (n,).
    """

    kind = "arx"

    def __init__(self, inputs: Array) -> None:
        known = inputs[np.isfinite(inputs)]
        low, high = (float(known.min()), float(known.max())) if known.size else (-np.inf, np.inf)
        margin = MARGIN * (high - low)
        self._low, self._high = low - margin, high + margin
        self.predictions: list[float] = []
        """Of the row that is to come, one an output."""

    @classmethod
    def from_state(cls, state: ArxReferenceState) -> "ArxReference":
        """The one of that state."""
        reference = cls(np.zeros(0))
        reference._low, reference._high = state.low, state.high
        return reference

    @property
    def state(self) -> ArxReferenceState:
        """See `Reference`."""
        return ArxReferenceState(self._low, self._high)

    def update(
        self, time_ns: int, input_value: float, values: list[float], accept: tuple[bool, ...], missing: int = 0
    ) -> Expected:
        """See `Reference`. Outside of what it was trained on, nothing can be said.

        Nor behind a row that is missing: the models begin anew there by themselves.
        """
        if self._low <= input_value <= self._high:
            return Expected(self.predictions, [1.0] * len(values))
        return Expected([nan] * len(values), [1.0] * len(values))

    def restart(self) -> None:
        """Nothing: the models begin anew by themselves."""


def places(model: ProcessModel, outputs: tuple[str, ...]) -> list[int]:
    """Where the outputs are among those of the model.

    Raises:
        InputError: one is not among them.
    """
    for output in outputs:
        if output not in model.output_names:
            raise InputError(
                f"reference 'process' needs outputs of the reactor, {', '.join(model.output_names)}, got {output!r}; "
                f'set reference = "arx"'
            )
    return [model.output_names.index(output) for output in outputs]


def input_reach(time_min: Array, inputs: Array) -> float:
    """Largest distance of the input of a row from those of the rows before and after it, whichever is nearer.

    It is 0 where each move lasts for two rows at least. Then the input of a missing row was that of a neighbour.

    Args:
        time_min: shape (n,).
        inputs: shape (n,); NaN where missing.
    """
    moved, is_next = np.abs(np.diff(inputs)), ~_are_behind_missing(time_min)[1:]
    nearer = np.where(is_next[:-1] & is_next[1:], np.minimum(moved[:-1], moved[1:]), 0.0)
    return float(np.nanmax(nearer, initial=0.0))


def _are_behind_missing(time_min: Array) -> NDArray[np.bool_]:
    """Rows before which, by the usual period, rows are missing, shape (n,)."""
    spacing = np.diff(time_min)
    period = float(np.median(spacing)) if spacing.size else 1.0
    return np.array([False, *(missing_rows(item / period) > 0 for item in spacing.tolist())])


def _until_missing(time_min: Array, inputs: Array) -> Array:
    """The inputs, with NaN in rows behind which rows are missing, so that a filter begins anew behind these."""
    return np.where(np.append(_are_behind_missing(time_min)[1:], False), nan, inputs)


def tuned(
    model: ProcessModel,
    outputs: tuple[str, ...],
    time_min: Array,
    inputs: Array,
    measured: Array,
    smallest_sd: list[float],
) -> NoiseLevels:
    """The noise of a plant and its sensors, from its training.

    Args:
        model: of the plant.
        outputs: the watched ones.
        time_min: shape (n,).
        inputs: shape (n,).
        measured: shape (n, outputs); NaN where missing or not to be learned from.
        smallest_sd: of the sensors, one an output.
    """
    whole = np.full((time_min.size, len(model.outputs)), np.nan)
    smallest = [1e-6] * len(model.outputs)
    for place, column, sd in zip(places(model, outputs), measured.T, smallest_sd, strict=True):
        whole[:, place], smallest[place] = column, sd
    return estimate_noise(model, time_min, _until_missing(time_min, inputs), whole, smallest)
