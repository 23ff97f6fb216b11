"""Rows of a training or an incident, from which a baseline is learned."""

from collections import deque
from collections.abc import Sequence
from math import isfinite

from reactorwatch.stored_state import StoredState, pack_numbers, pack_times, unpack_numbers, unpack_times

MOST_ROWS = 10_000
"""The newest rows used of a longer training; memory stays bounded."""


class TrainingState(StoredState, frozen=True):
    """State of a training.

    Attributes:
        times_ns: times of the rows, 64 bits each.
        rows: doubles: the inputs and the outputs of each row.
        known: number of values of each output.
    """

    times_ns: bytes
    rows: bytes
    known: list[int]


class TrainingRows:
    """The newest rows of one plant.

    Args:
        inputs: number of inputs.
        outputs: number of monitored outputs.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        self._inputs, self._outputs = inputs, outputs
        self._rows: deque[tuple[int, Sequence[float], list[float]]] = deque(maxlen=MOST_ROWS)
        self._counts = [0] * outputs

    @property
    def state(self) -> TrainingState:
        """A copy of the state."""
        rows = [(*inputs, *values) for _, inputs, values in self._rows]
        return TrainingState(pack_times(row[0] for row in self._rows), pack_numbers(rows), list(self._counts))

    def restore(self, state: TrainingState) -> None:
        """Resume from a state of the same settings.

        Raises:
            ValueError: the state is damaged.
        """
        inputs, outputs = self._inputs, self._outputs
        times_ns, rows = unpack_times(state.times_ns), unpack_numbers(state.rows, inputs + outputs).tolist()
        if len(times_ns) != len(rows) or len(state.known) != outputs:
            raise ValueError(f"a training must have a time a row and {outputs} counts, got {len(times_ns)} times")
        if len(times_ns) > MOST_ROWS:
            self.keep_all_rows()
        self._rows.extend(
            (time_ns, tuple(row[:inputs]), row[inputs:]) for time_ns, row in zip(times_ns, rows, strict=True)
        )
        self._counts = list(state.known)

    def add(self, time_ns: int, inputs: Sequence[float], values: list[float]) -> None:
        """Add a row.

        Args:
            time_ns: time of the row.
            inputs: one value an input; NaN if missing.
            values: outputs; NaN if missing.
        """
        if self._rows and time_ns <= self._rows[-1][0]:  # the publisher was restarted: so is the record
            self._rows.clear()
            self._counts = [0] * len(values)
        self._rows.append((time_ns, inputs, values))
        for index, value in enumerate(values):
            self._counts[index] += isfinite(value)

    @property
    def rows(self) -> int:
        """Number of rows so far."""
        return len(self._rows)

    def keep_all_rows(self) -> None:
        """Use all rows of the training, however many they are."""
        self._rows = deque(self._rows)

    def take(self) -> list[tuple[int, Sequence[float], list[float]]]:
        """The rows, each with its time, inputs and outputs; they are dropped."""
        rows, self._rows = list(self._rows), deque(maxlen=MOST_ROWS)
        self._counts = [0] * self._outputs
        return rows
