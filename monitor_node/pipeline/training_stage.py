"""Training of one plant, row by row, until there are rows enough to learn from."""

from monitor_node.baseline.training import MOST_REFUSALS, Training, TrainingResult
from monitor_node.baseline.training_rows import TrainingState
from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import MeasuredRow
from monitor_node.pipeline.identified_models import IdentifiedModels
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import unpack_times

TIMES_FEWEST = 2
"""Times the fewest rows of a training that a part of it needs to judge the rest: with fewer it is too rough."""


class TrainingStage:
    """The training of one plant.

    Args:
        config: settings of the monitor.
        model: process model of the plant; None if there is none.
        models: identified models, which start again with each training.

    Attributes:
        training: the rows so far.
        began_ns: start of the present or last training; None before its first row.
        refusals: number of refused trainings.
        trained_rows: number of rows of the training, after its end.
        is_open: True to train until the caller ends it.
    """

    def __init__(self, config: MonitorConfig, model: ProcessModel | None, models: IdentifiedModels) -> None:
        self._config, self._model, self._models = config, model, models
        self.refusals = self.trained_rows = 0
        self.is_open = False
        self.restart(None)

    def restart(self, time_ns: int | None) -> None:
        """Start again without a row."""
        self._models.restart()
        self.training = Training(self._config, self._model, self._models.predictors)
        self.began_ns = time_ns

    def take_over(self, rows: TrainingState) -> None:
        """Train on with the rows of an incident, by which the identified models are updated."""
        self.training.restore(rows)
        self.began_ns = unpack_times(rows.times_ns)[0]
        self._models.learn_again(rows)

    def open(self) -> None:
        """Train until the caller ends it, on all rows until then."""
        self.is_open = True
        self.training.keep_all_rows()

    @property
    def is_enough(self) -> bool:
        """True if there are enough rows with a value of each output."""
        return self.training.is_enough([False] * len(self._config.outputs))

    def start_clock(self, time_ns: int) -> None:
        """Count time from a row, unless an earlier one was first."""
        if self.began_ns is None or time_ns < self.began_ns:
            self.began_ns = time_ns

    def share(self, time_ns: int, rows_before: int = 0) -> float:
        """Share of the training that is done at a time; above 1 when it is overdue.

        Args:
            time_ns: time of a row.
            rows_before: number of rows in other modes, which count as well.
        """
        if self.began_ns is None:
            return 0.0
        minutes = (time_ns - self.began_ns) / MINUTE_NS
        return self._config.training_length.share(minutes, self.training.rows + rows_before)

    def add(self, row: MeasuredRow) -> None:
        """Add a row, and update the identified models with it."""
        self.training.add(row.time_ns, row.inputs, row.values)
        self._models.update(row, beside=False)

    def finish(self, *, last_chance: bool | None = None) -> tuple[TrainingState, TrainingResult]:
        """Learn from the rows; returns them and the result.

        Args:
            last_chance: True to use the training even if it is disturbed; None: after some refusals.
        """
        rows, count = self.training.state, self.training.rows
        is_last = self.refusals >= MOST_REFUSALS if last_chance is None else last_chance
        result = self.training.finish(last_chance=is_last)
        self.trained_rows = count
        return rows, result

    def finish_early(self, *, times: int = 1) -> tuple[TrainingState, TrainingResult]:
        """Learn from the rows so far; returns them and the result.

        Args:
            times: times the fewest rows that a training needs, for which this one must do.

        Raises:
            InputError: there are too few rows to learn from, or no output can be watched.
        """
        fewest = times * self.training.fewest_rows
        if self.training.rows < fewest or not self.is_enough:
            raise InputError(
                f"must have at least {fewest} rows with a value of each output to learn from, got "
                f"{self.training.rows} rows"
            )
        rows, result = self.finish(last_chance=True)
        if result.refused:
            raise InputError(f"there is no output to watch: {result.refused}")
        return rows, result
