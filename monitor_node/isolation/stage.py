"""Search of the cause of an alarm: the schedule of its looks, the rows they use, and their publication.

A look at all causes takes tenths of a second. So it is taken some rows after the first alarm of an incident and again
when three times as many have come, as long as an alarm is active that does not name its cause itself. A slow fault, or
one that others imitate, is only distinguished by many rows: the last looks follow after more than a thousand. Until
then the rows since the alarm are kept, and `ROWS_BEFORE` before it: a slow ramp is noticed hundreds of rows after its
onset. A plant without an unexplained alarm keeps `isolation_rows` rows.

Between looks and after the last one the probabilities follow the rows (`live_posterior`). They are published when one
has moved by `WORTH_PUBLISHING`. If the rows come to contradict what the last look named, as when a ramp ends, the next
look is taken at once.

The result depends on the samples alone. While the most likely cause is a sensor, its true reading is reconstructed.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress

import msgspec

from monitor_node.alarms.alarms import STUCK_SENSOR, SuspectedCause
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.process_reference import ProcessReference, output_indices
from monitor_node.config import MonitorConfig
from monitor_node.isolation.candidate import ProgressState
from monitor_node.isolation.causes import causes_of
from monitor_node.isolation.isolation import Isolation
from monitor_node.isolation.live_posterior import LivePosterior, LivePosteriorState
from monitor_node.isolation.reconstruction import Reconstruction, ReconstructionState
from monitor_node.isolation.suspect import UNKNOWN, Suspect
from monitor_node.isolation.window import Row, newest_rows
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Reconstruction as ReconstructionMessage
from reactorwatch.kalman.ekf import NoiseLevels
from reactorwatch.process.effect import SensorEffect
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import Memory, pack_numbers, unpack_numbers

LOOKS = (10, 30, 100, 300, 1000, 1300)
"""Numbers of rows after the first alarm of an incident at which the causes are compared."""

FEW_ROWS = 300
"""Later looks are left out if rows are so far apart that not all since the alarm could be used (`newest_rows`)."""

ROWS_BEFORE = 400
"""Number of rows before the first alarm that late looks use."""

LEAST = 0.01
"""Probability below which a suspect is not published."""

LEAST_GROWTH = 1.3
"""Factor by which the rows since the alarm have to grow until a look that is not in `LOOKS`."""

WORTH_PUBLISHING = 0.1
"""Change of a probability since the last publication that is worth another one."""

CONVINCED = 0.5
"""Probability from which a suspected sensor is reconstructed."""


def preparation(config: MonitorConfig, model: ProcessModel | None) -> Iterator[None]:
    """Compile what the first look for causes would compile, one part for each item of the iterator.

    All parts take about a second of processor time, or ten if nothing is in the cache on the disk.

    Args:
        config: settings of the monitor.
        model: process model of the plant; None without one.
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
    """Return true if causes are searched with this model: the catalogue has some, and the plant is driven."""
    return config.isolation and bool(model.inputs and causes_of(model))


class SuspicionMemory(Memory, kw_only=True):
    """Memory of a search for causes beside its parts, while it runs and in its stored state.

    Attributes:
        incident: number of the latest incident with a search.
        since: number of rows since its first alarm; None: no active alarm has an unknown cause.
        output: output of the newest reconstruction.
        cause: cause of the reconstruction.
        published: probabilities of the suspects that were published last, by cause.
        named_rows: number of rows since the first alarm at the last look, if it named a cause; else 0.
    """

    incident: int = 0
    since: int | None = None
    output: str = ""
    cause: str = ""
    published: dict[str, float] = msgspec.field(default_factory=dict)
    named_rows: int = 0


class SuspicionState(SuspicionMemory, kw_only=True):
    """State of the search for causes: its memory and its parts.

    Attributes:
        rows: newest rows as doubles: time in minutes, inputs, outputs of the model.
        way: `ProgressState` of a large fault; None without one. Earlier versions stored another structure, which is
            ignored: the fault is then followed from its start again.
        reconstruction: state of the reconstruction; None without one.
        live: state of the probabilities that follow the rows; None without an active alarm of unknown cause.
    """

    rows: bytes
    way: object = None
    reconstruction: ReconstructionState | None = None
    live: LivePosteriorState | None = None


class Suspicion:
    """Searches the causes of one plant's alarms.

    Args:
        config: settings of the monitor.
        board: annunciator of the plant.
        reference: reference by which the rows are predicted.
    """

    def __init__(self, config: MonitorConfig, board: Annunciator, reference: ProcessReference) -> None:
        self._config, self._board, self._reference = config, board, reference
        self._indices = output_indices(reference.equations, config.outputs)
        self._all_watched = self._indices == list(range(len(reference.equations.outputs)))
        self._effects = {effect.name: effect for effect in causes_of(reference.equations)}
        self._isolation: Isolation | None = None
        self._live: LivePosterior | None = None
        # Flat, as most of the memory of a plant: time in minutes, inputs, outputs of the model.
        self._rows: deque[tuple[float, ...]] = deque(maxlen=config.isolation_rows)
        self._reconstruction: Reconstruction | None = None
        self._memory = SuspicionMemory()

    @property
    def state(self) -> SuspicionState:
        """A copy of the state."""
        progress = None if self._isolation is None else self._isolation.progress
        return SuspicionState(
            **msgspec.structs.asdict(self._memory),
            rows=pack_numbers(list(self._rows)),
            way=None if progress is None else msgspec.to_builtins(progress),
            reconstruction=None if self._reconstruction is None else self._reconstruction.state,
            live=None if self._live is None else self._live.state,
        )

    def restore(self, state: SuspicionState) -> None:
        """Resume from the state of another search for the same plant.

        Raises:
            ValueError: the state is damaged.
        """
        model = self._reference.equations
        self._memory = msgspec.convert(state, SuspicionMemory, from_attributes=True)
        self._set_since(state.since)
        self._rows.extend(map(tuple, unpack_numbers(state.rows, 1 + len(model.inputs) + len(model.outputs)).tolist()))
        if state.way is not None:
            with suppress(msgspec.ValidationError):  # stored by an earlier version
                self._made_isolation().progress = msgspec.convert(state.way, ProgressState)
        if state.live is not None:
            live = self._made_isolation().new_live_posterior()
            self._live = live if live.restore(state.live) else None
        if state.reconstruction is not None:
            self._reconstruct(state.output, state.cause, 0.0, ())
            assert self._reconstruction is not None
            self._reconstruction.restore(state.reconstruction)

    def update(
        self, time_ns: int, inputs: Sequence[float], values: list[float], units: list[str], stuck: list[bool]
    ) -> list[Publication]:
        """Process a row after its alarms.

        Args:
            time_ns: time of the row.
            inputs: one value an input; NaN if missing.
            values: outputs; NaN where missing.
            units: units of the outputs.
            stuck: flags of the outputs whose sensors are stuck; their values are missing.
        """
        time_min = time_ns / MINUTE_NS
        measured = self.add(time_min, inputs, values)
        board = self._board
        if not board.has_unexplained and True not in stuck:  # the usual case
            self._reconstruction = None
            if self._memory.since is not None:
                self._set_since(None)
            return []
        if True in stuck:
            self._reconstruct(self._config.outputs[stuck.index(True)], STUCK_SENSOR, time_min, self._split_rows()[:-1])
        elif self._memory.cause == STUCK_SENSOR or not board.has_unexplained:
            self._reconstruction = None
        publications = self._publish_reconstruction(time_ns, inputs, measured, values, units)
        if not board.has_unexplained:
            self._set_since(None)
            return publications
        is_new = self._memory.since is None or board.incident != self._memory.incident
        self._memory.incident = board.incident
        if is_new:
            self._live = None
            if self._isolation is not None:
                self._isolation.progress = None
        since = 1 if is_new or self._memory.since is None else self._memory.since + 1
        self._set_since(since)
        if since in LOOKS and self._has_rows(since):
            publications += self._look(time_ns, since)
        elif self._live is not None:
            publications += self._follow_causes(self._live, time_ns, inputs, measured)
        return publications

    def _set_since(self, since: int | None) -> None:
        """Set the number of rows since the first alarm; more rows are kept as long as looks follow."""
        self._memory.since = since
        if since is None:
            self._live, self._memory.published, self._memory.named_rows = None, {}, 0
        usual = self._config.isolation_rows
        if since is not None and since <= LOOKS[-1]:
            usual = max(usual, min(usual, ROWS_BEFORE) + LOOKS[-1])
        elif self._isolation is not None:
            self._isolation.progress = None
        if self._rows.maxlen != usual:
            self._rows = deque(self._rows, maxlen=usual)

    def _is_early_look_useful(self, since: int) -> bool:
        """Return true if the last look named a cause, and enough rows have come since."""
        return 0 < LEAST_GROWTH * self._memory.named_rows <= since < LOOKS[-1]

    def _has_rows(self, since: int) -> bool:
        """Return true if the rows for a look are known; late looks need rows that are not far apart."""
        return since <= FEW_ROWS or len(newest_rows(self._rows_of_look(since))) > since

    def _rows_of_look(self, since: int) -> list[Row]:
        """Rows for a look: the usual number, and later `ROWS_BEFORE` rows before the first alarm and all since."""
        usual = self._config.isolation_rows
        return self._split_rows()[-max(usual, min(usual, ROWS_BEFORE) + since) :]

    def _split_rows(self) -> list[Row]:
        inputs = 1 + len(self._reference.equations.inputs)
        return [(row[0], row[1:inputs], row[inputs:]) for row in self._rows]

    def _look(self, time_ns: int, since: int) -> list[Publication]:
        isolation = self._made_isolation()
        suspects = isolation.suspects(self._rows_of_look(since), min(since, FEW_ROWS))
        publications = self._publish(time_ns, suspects, stopped=isolation.stopped)
        self._live = isolation.follow()
        self._memory.named_rows = since if suspects[0].cause != UNKNOWN else 0
        return publications

    def _follow_causes(
        self, live: LivePosterior, time_ns: int, inputs: Sequence[float], measured: Sequence[float]
    ) -> list[Publication]:
        """Update the probabilities of the causes, and publish them if they changed."""
        if not live.update(time_ns / MINUTE_NS, inputs, measured):
            self._live = None
            return []
        before, since = self._memory.published, self._memory.since or 0
        may_look = self._is_early_look_useful(since)
        if not live.has_moved(WORTH_PUBLISHING - LEAST):  # suspects below `LEAST` are not published
            is_unknown = max(before, key=before.__getitem__, default="") == UNKNOWN
            if not (is_unknown and may_look):
                return []
        suspects = live.suspects()
        contradicts = suspects[0].cause == UNKNOWN and suspects[0].probability > CONVINCED
        if contradicts and may_look and self._has_rows(since):
            return self._look(time_ns, since)
        probabilities = {item.cause: item.probability for item in suspects}
        changes = (abs(probabilities.get(cause, 0.0) - before.get(cause, 0.0)) for cause in {*probabilities, *before})
        if max(changes) < WORTH_PUBLISHING:
            return []
        live.note_published()
        return self._publish(time_ns, suspects)

    def _publish(self, time_ns: int, suspects: Sequence[Suspect], *, stopped: bool = False) -> list[Publication]:
        self._memory.published = {item.cause: item.probability for item in suspects if item.probability >= LEAST}
        causes = [self._suspected_cause(item) for item in suspects if item.probability >= LEAST]
        publications = self._board.set_suspects(time_ns, causes, stopped=stopped)
        self._follow(suspects[0])
        return publications

    def add(self, time_min: float, inputs: Sequence[float], values: Sequence[float]) -> Sequence[float]:
        """Add a row; returns its outputs of the model."""
        measured = self._model_outputs(values)
        if self._rows and time_min <= self._rows[-1][0]:  # the plant's clock was set back
            self._rows.clear()
            self._isolation = self._live = None
        self._rows.append((time_min, *inputs, *measured))
        return measured

    def _made_isolation(self) -> Isolation:
        """Make the isolation at the first alarm: few of thousands of plants ever have one."""
        if self._isolation is None:
            reference = self._reference
            self._isolation = Isolation(reference.equations, reference.plant_noise, self._config.isolation_rows)
        return self._isolation

    def _model_outputs(self, values: Sequence[float]) -> Sequence[float]:
        """Outputs of the model; NaN for those that are not monitored."""
        if self._all_watched:
            return values
        measured = [float("nan")] * len(self._reference.equations.outputs)
        for index, value in zip(self._indices, values, strict=True):
            measured[index] = value
        return measured

    def _follow(self, suspect: Suspect) -> None:
        """Start or stop the reconstruction of a sensor."""
        effect = self._effects.get(suspect.cause)
        output = effect.output if isinstance(effect, SensorEffect) else ""
        if suspect.probability >= CONVINCED and output in self._config.outputs:
            self._reconstruct(output, suspect.cause, suspect.onset_min, self._split_rows())
        elif self._memory.cause != STUCK_SENSOR:
            self._reconstruction = None

    def _reconstruct(self, output: str, cause: str, onset_min: float, rows: Iterable[Row]) -> None:
        """Start to reconstruct the sensor of an output after these rows, unless that is done already."""
        if self._reconstruction is None or (output, cause) != (self._memory.output, self._memory.cause):
            model, noise = self._reference.equations, self._reference.plant_noise
            index = model.output_names.index(output)
            self._reconstruction = Reconstruction(model, noise, index, rows, onset_min)
        self._memory.output, self._memory.cause = output, cause

    def _publish_reconstruction(
        self, time_ns: int, inputs: Sequence[float], measured: Sequence[float], values: list[float], units: list[str]
    ) -> list[Publication]:
        if self._reconstruction is None:
            return []
        value, sd = self._reconstruction.update(time_ns / MINUTE_NS, inputs, measured)
        index = self._config.outputs.index(self._memory.output)
        message = ReconstructionMessage(
            time_ns=time_ns, value=value, sd=sd, unit=units[index], measured=values[index], cause=self._memory.cause
        )
        return [Publication(keys.key(self._config.plant, keys.RECONSTRUCTION, self._memory.output), message)]

    def _suspected_cause(self, suspect: Suspect) -> SuspectedCause:
        if suspect.cause == UNKNOWN:
            return SuspectedCause(UNKNOWN, suspect.probability)
        effect = self._effects[suspect.cause]
        return SuspectedCause(
            suspect.cause,
            suspect.probability,
            suspect.profile,
            suspect.size,
            suspect.size_sd,
            effect.unit,
            round(suspect.onset_min * MINUTE_NS),
            suspect.onset_sd_min,
            suspect.kind,
            effect.describe(suspect.size),
        )
