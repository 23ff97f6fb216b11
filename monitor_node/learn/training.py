"""Training of one plant, row by row, until there are rows enough to learn its baseline from.

A training with too much disturbance is refused and starts again. The third is used in full: a plant that never rests
is monitored as well.
"""

from collections.abc import Sequence
from itertools import compress
from operator import ge, not_

from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import MeasuredRow
from monitor_node.learn import arx_fit
from monitor_node.learn.arx import ArxReference
from monitor_node.learn.baseline import TrainingResult, fewest_values, learn_baseline, needed_values
from monitor_node.learn.training_rows import TrainingRows
from reactorwatch.errors import UnfitRecordError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import Memory


class TrainingMemory(Memory):
    """Memory of the training of a plant.

    Attributes:
        rows: rows of the present training.
        began_ns: start of the present or last training; None before its first row.
        refusals: number of refused trainings.
    """

    rows: TrainingRows
    began_ns: int | None = None
    refusals: int = 0


class Training:
    """The training of one plant.

    Attributes:
        memory: the rows so far, and the refusals before.
        refused: reason of the last refusal; empty before one.
        trained_rows: number of rows of the training, after its end.
        is_open: True to train until the caller ends it.
    """

    def __init__(self, config: MonitorConfig, model: ProcessModel | None, models: ArxReference) -> None:
        self._config, self._model, self._models = config, model, models
        self._fewest_values = fewest_values(config, model)
        self.memory = TrainingMemory(self._no_rows)
        self.trained_rows = 0
        self.is_open, self.refused = False, ""
        self.restart(None)

    @property
    def _no_rows(self) -> TrainingRows:
        return TrainingRows([0] * len(self._config.outputs))

    def restart(self, time_ns: int | None) -> None:
        """Start again without a row."""
        self._models.forget()
        self.memory.rows, self.memory.began_ns = self._no_rows, time_ns

    def refuse(self, reason: str, time_ns: int) -> str:
        """Refuse the training, and start it again; returns a note."""
        self.memory.refusals, self.refused = self.memory.refusals + 1, reason
        self.restart(time_ns)
        return f"the training starts again: {reason}"

    def take_over(self, rows: TrainingRows) -> None:
        """Train on with the rows of an incident, by which the identified models are updated."""
        self.memory.rows, self.memory.began_ns = rows, rows.times_ns[0]
        arx_fit.learn_again(self._models, rows.arrays)

    def open(self) -> None:
        """Train until the caller ends it, on all rows until then."""
        self.is_open = True
        self.memory.rows.keeps_all = True

    def is_enough(self, timed_out: Sequence[bool] = ()) -> bool:
        """True if there are enough rows with a value of each output, but for those whose data timeout is active."""
        counts = self.memory.rows.counts
        if timed_out:
            counts = list(compress(counts, map(not_, timed_out)))
        rows, by_equations = len(self.memory.rows.times), self._model is not None
        fewest = (needed_values(count, rows, self._fewest_values, by_equations=by_equations) for count in counts)
        return bool(counts) and all(map(ge, counts, fewest))

    def start_clock(self, time_ns: int) -> None:
        """Count time from a row, unless an earlier one was first."""
        if self.memory.began_ns is None or time_ns < self.memory.began_ns:
            self.memory.began_ns = time_ns

    def share(self, period_ns: float, rows_before: int = 0) -> float:
        """Share of the training that is done, at most 1; rows before it, in other modes, count as well."""
        if not period_ns:
            return 0.0
        rows, wanted = self.memory.rows, self._config.training_length.count_rows(period_ns / MINUTE_NS)
        return min((rows.dropped + len(rows.times) + rows_before) / wanted, 1.0)

    def add(self, row: MeasuredRow) -> list[float]:
        """Add a row, and update the identified models with it; returns predictions if they are published."""
        self.memory.rows.add(row.time_ns, row.inputs, row.values)
        return self._models.adapt(row)

    def finish(self, *, last_chance: bool | None = None) -> TrainingResult:
        """Learn from the rows, even if they are disturbed at the last chance: as given, or after some refusals."""
        rows, self.memory.rows = self.memory.rows, self._no_rows
        is_last = self.memory.refusals >= 2 if last_chance is None else last_chance
        self.trained_rows = len(rows.times)
        return learn_baseline(self._config, self._model, self._models, rows, last_chance=is_last)

    def finish_early(self, *, times: int = 1) -> TrainingResult:
        """Learn from the rows so far.

        Raises:
            InputError: there are too few rows to learn from, or no output can be watched.
        """
        fewest = times * self._fewest_values
        count = len(self.memory.rows.times)
        if count < fewest or not self.is_enough():
            raise UnfitRecordError(
                f"must have at least {fewest} rows with a value of each output to learn from, got {count} rows"
            )
        result = self.finish(last_chance=True)
        if result.refused:
            raise UnfitRecordError(f"there is no output to watch: {result.refused}")
        return result
