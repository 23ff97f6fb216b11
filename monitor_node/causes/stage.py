"""Search of the cause of an alarm: the schedule of its looks, the rows they use, and their publication.

A look at all causes takes tenths of a second. So it is taken some rows after the first alarm of an incident and again
when about one and a half times as many have come (`LOOKS`), as long as an alarm is active that does not name its cause
itself. A slow fault, or one that others imitate, is only distinguished by many rows: the last looks follow after more
than a thousand. Until then the rows since the alarm are kept, and `ROWS_BEFORE` before it: a slow ramp is noticed
hundreds of rows after its onset. A plant without an unexplained alarm keeps `isolation_rows` rows.

A fault is judged by rows from before it on. So if the rows break off, by a long gap or because the plant's clock was
set back, the causes found before stay, and no look follows for this incident; one is taken at once if none was yet.

Suspects change at looks, not at rows.

The result depends on the samples alone. While the most likely cause is a sensor, its true reading is reconstructed
(`Reconstruction`).
"""

from collections.abc import Iterable, Iterator, Sequence
from math import isfinite, nan, sqrt

from monitor_node.alarms.alarms import STUCK_SENSOR, SuspectedCause
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.causes.isolation import UNKNOWN, Isolation, causes_of
from monitor_node.causes.scan import Progress
from monitor_node.causes.window import MOST_PIECES, RecentRows, Row, is_break, newest_rows, rows_since_break
from monitor_node.config import MonitorConfig
from monitor_node.learn.process_reference import output_indices
from monitor_node.learn.references import PlantEquations
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Reconstruction as ReconstructionMessage
from reactorwatch.kalman.batch import BudgetExceededError, StepBudget, StepCost
from reactorwatch.kalman.ekf import Filter, FilterState
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.effect import SensorEffect
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import Memory

LOOKS = (10, 15, 25, 40, 60, 100, 150, 250, 400, 600, 1000, 1300)
"""Numbers of rows after the first alarm of an incident at which the causes are compared."""

FEW_ROWS = 300
"""Later looks are left out if rows are so far apart that not all since the alarm could be used (`newest_rows`)."""

ROWS_BEFORE = 400
"""Number of rows before the first alarm that late looks use."""

START_STEPS, START_STEPS_A_ROW = 25_000 + StepCost.PREDICTION * MOST_PIECES, StepCost.ROW
"""Filter steps for the past rows: enough for each row and a search for steady states."""


def preparation(config: MonitorConfig, model: ProcessModel | None) -> Iterator[None]:
    """Compile what the first look for causes would compile, one part for each item of the iterator.

    All parts take about a second of processor time, or ten if nothing is in the cache on the disk.
    """
    if model is None or not has_causes(config, model):
        return
    noise = NoiseLevels((1.0,) * len(model.outputs), (0.0,) * len(model.states))
    try:
        for prepare in Isolation(model, noise, config.isolation_rows).preparations:
            prepare()
            yield
    except Exception:  # noqa: BLE001 # the first look raises it again, at the stage's border, which counts and logs it
        return


def has_causes(config: MonitorConfig, model: ProcessModel) -> bool:
    """Return true if causes are searched with this model: the settings want it, and it has some."""
    return config.isolation and bool(causes_of(model))


def select_likely(suspects: Sequence[SuspectedCause]) -> list[SuspectedCause]:
    """Select the suspects that are published, of those that are given likeliest first.

    These are the ones with a probability of 1 % and, of the two likeliest causes, each with 1 % if it is a cause: of
    a plant that is not quite its model `UNKNOWN` has nearly all of the probability soon, whatever the cause.
    """
    causes = [item for item in suspects if item.cause != UNKNOWN]
    least = 0.01 * sum(item.probability for item in causes)
    nearest = [item.cause for item in causes[:2] if item.probability >= least > 0.0]
    return [item for item in suspects if item.probability >= 0.01 or item.cause in nearest]


class ReconstructionMemory(Memory):
    """Memory of a reconstruction.

    Attributes:
        output: output of the sensor.
        cause: suspected cause.
        last_inputs: last known inputs; NaN before the first.
        filter: state of the filter; None before its first row.
    """

    output: str
    cause: str
    last_inputs: list[float]
    filter: FilterState | None = None


class SuspicionMemory(Memory, kw_only=True):
    """Memory of a search for causes.

    Attributes:
        rows: newest rows, with the outputs of the model.
        incident: number of the latest incident with a search.
        since: number of rows since its first alarm; None: no active alarm has an unknown cause.
        progress: progress with a large fault; None without one.
        reconstruction: memory of the reconstruction; None without one.
    """

    rows: RecentRows
    incident: int = 0
    since: int | None = None
    progress: Progress | None = None
    reconstruction: ReconstructionMemory | None = None


class Reconstruction:
    """Reconstructs the true reading of a faulty sensor: follows the plant without it.

    From the start of its fault the sensor is left out of the filter, and its true reading is predicted from the
    balances and the other sensors. It is not corrected by the size of its fault: that would be only as good as the
    known form of the fault, and this holds for a sensor that drifts, sticks or fails in any other way. It costs some
    accuracy.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, memory: ReconstructionMemory) -> None:
        self.memory, self._filter = memory, Filter(model, noise)
        self._index = model.output_names.index(memory.output)
        self._variance = noise.measurement_sd[self._index] ** 2
        if memory.filter is not None:
            self._filter.state = memory.filter

    def start(self, rows: Iterable[Row], onset_min: float) -> None:
        """Process the rows from before the onset on, oldest first."""
        past = newest_rows(list(rows))
        self._filter.budget = StepBudget(START_STEPS + START_STEPS_A_ROW * len(past))
        try:
            for time_min, inputs, measured in past:
                # the sensor is left out from a minute before the estimated onset on
                self._step(time_min, inputs, measured, is_right=time_min < onset_min - 1.0)
        except BudgetExceededError:  # the filter diverges again and again: start with the next row instead
            self._filter.restart()
        self._filter.budget, self.memory.filter = None, self._filter.state

    def update(self, time_min: float, inputs: Sequence[float], measured: Sequence[float]) -> tuple[float, float]:
        """Process a row and return the true reading without noise and its standard deviation, in the output's unit.

        Both are NaN in the row with which the filter starts.
        """
        return self._step(time_min, inputs, measured, is_right=False)

    def _step(
        self, time_min: float, inputs: Sequence[float], measured: Sequence[float], *, is_right: bool
    ) -> tuple[float, float]:
        known = [now if isfinite(now) else last for now, last in zip(inputs, self.memory.last_inputs, strict=True)]
        self.memory.last_inputs = known
        if not all(map(isfinite, known)):
            return nan, nan
        seen = list(measured)
        if not is_right:
            seen[self._index] = nan
        found = self._filter.update(time_min, known, seen)
        self.memory.filter = self._filter.state
        variance = found.sd[self._index] ** 2 - self._variance
        return found.prediction[self._index], sqrt(max(variance, 0.0)) if variance == variance else nan


class Suspicion:
    """Searches the causes of one plant's alarms.

    Raises:
        ValueError: the memory is damaged.
    """

    def __init__(
        self,
        config: MonitorConfig,
        board: Annunciator,
        reference: PlantEquations,
        memory: SuspicionMemory | None = None,
    ) -> None:
        self._config, self._board, self._reference = config, board, reference
        model = reference.equations
        self._indices = output_indices(model, config.outputs)
        self._all_watched = self._indices == list(range(len(model.outputs)))
        self._effects = {effect.name: effect for effect in causes_of(model)}
        self._isolation: Isolation | None = None
        self._reconstruction: Reconstruction | None = None
        n_inputs, columns = len(model.inputs), 1 + len(model.inputs) + len(model.outputs)
        self.memory = memory or SuspicionMemory(rows=RecentRows(n_inputs, columns, config.isolation_rows))
        if self.memory.rows.columns != columns or len(self.memory.rows.numbers) % columns:
            raise ValueError("the rows of the search for causes must have the signals of the model")
        if self.memory.reconstruction is not None:
            self._reconstruction = Reconstruction(model, reference.plant_noise, self.memory.reconstruction)

    def update(
        self, time_ns: int, inputs: Sequence[float], values: list[float], units: list[str], stuck: list[bool]
    ) -> list[Publication]:
        """Process a row after its alarms; values of stuck sensors are missing."""
        time_min, since = time_ns / MINUTE_NS, self.memory.since
        publications: list[Publication] = []
        rows = self.memory.rows
        if since is not None and since < LOOKS[0] and is_break(rows.rows(), time_min) and self._has_rows(since):
            self._look(since)
        measured = self.add(time_min, inputs, values)
        board = self._board
        if not board.has_unexplained and True not in stuck:  # the usual case
            self._stop_reconstruction()
            if self.memory.since is not None:
                self._set_since(None)
            return publications
        if True in stuck:
            self._reconstruct(self._config.outputs[stuck.index(True)], STUCK_SENSOR, time_min, rows.rows()[:-1])
        elif self._reconstructed_cause == STUCK_SENSOR or not board.has_unexplained:
            self._stop_reconstruction()
        publications += self._publish_reconstruction(time_ns, inputs, measured, values, units)
        if not board.has_unexplained:
            self._set_since(None)
            return publications
        is_new = self.memory.since is None or board.incident != self.memory.incident
        self.memory.incident = board.incident
        if is_new:
            self.memory.progress = None
        since = 1 if is_new or self.memory.since is None else self.memory.since + 1
        self._set_since(since)
        if since in LOOKS and self._has_rows(since):
            self._look(since)
        return publications

    def _set_since(self, since: int | None) -> None:
        """Set the number of rows since the first alarm; more rows are kept as long as looks follow."""
        self.memory.since = since
        usual = self._config.isolation_rows
        if since is not None and since <= LOOKS[-1]:
            usual = max(usual, min(usual, ROWS_BEFORE) + LOOKS[-1])
        else:
            self.memory.progress = None
        if self.memory.rows.most != usual:
            self.memory.rows.keep(usual)

    def _has_rows(self, since: int) -> bool:
        """Return true if all rows since the first alarm are there; late looks need rows that are not far apart."""
        rows = self._rows_of_look(since)
        is_whole = len(rows_since_break(rows)) >= since
        return is_whole and (since <= FEW_ROWS or len(newest_rows(rows)) > since)

    def _rows_of_look(self, since: int) -> list[Row]:
        """Rows for a look: the usual number, and later `ROWS_BEFORE` rows before the first alarm and all since."""
        usual = self._config.isolation_rows
        return self.memory.rows.rows()[-max(usual, min(usual, ROWS_BEFORE) + since) :]

    def _look(self, since: int) -> None:
        reference = self._reference
        if self._isolation is None:  # few of thousands of plants ever have an alarm
            self._isolation = Isolation(reference.equations, reference.plant_noise, self._config.isolation_rows)
        isolation = self._isolation
        isolation.fitter.progress = self.memory.progress
        suspects = isolation.suspects(self._rows_of_look(since), min(since, FEW_ROWS))
        self.memory.progress = isolation.fitter.progress
        self._board.set_suspects(select_likely(suspects), stopped=isolation.stopped)
        self._follow(suspects[0])

    def add(self, time_min: float, inputs: Sequence[float], values: Sequence[float]) -> Sequence[float]:
        """Add a row; returns its outputs of the model."""
        measured = self._model_outputs(values)
        if not self.memory.rows.add((time_min, *inputs, *measured)):  # the plant's clock was set back
            self.memory.progress = None
        return measured

    def _model_outputs(self, values: Sequence[float]) -> Sequence[float]:
        """Outputs of the model; NaN for those that are not monitored."""
        if self._all_watched:
            return values
        measured = [nan] * len(self._reference.equations.outputs)
        for index, value in zip(self._indices, values, strict=True):
            measured[index] = value
        return measured

    def _follow(self, suspect: SuspectedCause) -> None:
        """Start or stop the reconstruction of a sensor."""
        effect = self._effects.get(suspect.cause)
        output = effect.output if isinstance(effect, SensorEffect) else ""
        if suspect.probability >= 0.5 and output in self._config.outputs:
            self._reconstruct(output, suspect.cause, suspect.onset_ns / MINUTE_NS, self.memory.rows.rows())
        elif self._reconstructed_cause != STUCK_SENSOR:
            self._stop_reconstruction()

    @property
    def _reconstructed_cause(self) -> str:
        return "" if self.memory.reconstruction is None else self.memory.reconstruction.cause

    def _stop_reconstruction(self) -> None:
        self._reconstruction = self.memory.reconstruction = None

    def _reconstruct(self, output: str, cause: str, onset_min: float, rows: Iterable[Row]) -> None:
        """Start to reconstruct the sensor of an output after these rows, unless that is done already."""
        running = self.memory.reconstruction
        if running is None or (output, cause) != (running.output, running.cause):
            model, noise = self._reference.equations, self._reference.plant_noise
            memory = self.memory.reconstruction = ReconstructionMemory(output, cause, [nan] * len(model.inputs))
            self._reconstruction = Reconstruction(model, noise, memory)
            self._reconstruction.start(rows, onset_min)

    def _publish_reconstruction(
        self, time_ns: int, inputs: Sequence[float], measured: Sequence[float], values: list[float], units: list[str]
    ) -> list[Publication]:
        if self._reconstruction is None:
            return []
        value, sd = self._reconstruction.update(time_ns / MINUTE_NS, inputs, measured)
        output, cause = self._reconstruction.memory.output, self._reconstruction.memory.cause
        index = self._config.outputs.index(output)
        message = ReconstructionMessage(
            time_ns=time_ns, value=value, sd=sd, unit=units[index], measured=values[index], cause=cause
        )
        return [Publication(keys.key(self._config.plant, keys.RECONSTRUCTION, output), message)]
