"""From an alarm to its cause: when the causes are compared, and what is told of it.

Comparing all causes takes tenths of a second, so it is not done at every row but some rows after the first alarm of an
incident, and again when three times as many have come, as long as an alarm stands that does not say itself what it
is. What is then told follows from the samples alone. While the likeliest suspect is a sensor, it is also told what that
sensor would read were it right.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from math import inf

from monitor_node.alarms.alarms import STUCK_SENSOR, SuspectedCause
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.references import ProcessReference, output_indices
from monitor_node.config import MonitorConfig
from monitor_node.isolation.causes import CAUSES
from monitor_node.isolation.fit import WayState
from monitor_node.isolation.isolation import UNKNOWN, Isolation, Suspect
from monitor_node.isolation.reconstruction import Reconstruction, ReconstructionState
from monitor_node.isolation.window import Row
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Reconstruction as ReconstructionMessage
from reactorwatch.kalman.ekf import NoiseLevels
from reactorwatch.process.effect import SensorEffect
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import StoredState, packed, unpacked

LOOKS = (10, 30, 100, 300)
"""Rows after the first alarm of an incident at which the causes are compared."""

LEAST = 0.01
"""Suspects that are less likely are not told."""

CONVINCED = 0.5
"""A sensor that is at least so likely the cause is reconstructed."""

UNITS = {effect.name: effect.unit for effect in CAUSES}
OUTPUTS = {effect.name: effect.output for effect in CAUSES if isinstance(effect, SensorEffect)}


def preparation(config: MonitorConfig, model: ProcessModel | None) -> Iterator[None]:
    """Make, part by part, what the first look for causes would make; one is made for each item that is asked for.

    In all it takes about a second of the processor, or ten if nothing is on the disk.

    Args:
        config: of the monitor.
        model: that the plant may be watched by; None: there is none.
    """
    if model is None or not has_causes(config, model):
        return
    noise = NoiseLevels((1.0,) * len(model.outputs), (0.0,) * len(model.states))
    try:
        for prepare in Isolation(model, noise, config.isolation_rows).preparations:
            prepare()
            yield
    except Exception:  # noqa: BLE001 # the first look meets it again, at the plant's border, which counts and logs it
        return


def has_causes(config: MonitorConfig, model: ProcessModel) -> bool:
    """True if causes are looked for where rows are judged by this model; the causes are those of the reactor."""
    return config.isolation and model.name == cstr().name


class SuspicionState(StoredState, frozen=True):
    """All that is remembered.

    Attributes:
        rows: the newest, doubles: time in minutes, input, outputs of the model.
        incident: that was looked at last.
        since: rows since its first alarm; None: no alarm stands that has to be explained.
        way: how far its fault has been followed.
        output: whose sensor is, or was last, reconstructed.
        cause: and why.
        reconstruction: None: there is none.
    """

    rows: bytes
    incident: int
    since: int | None
    way: WayState | None
    output: str
    cause: str
    reconstruction: ReconstructionState | None


class Suspicion:
    """Looks for the causes of one plant's alarms.

    Args:
        config: of the monitor.
        board: the alarms of the plant.
        reference: what its rows are expected by.
    """

    def __init__(self, config: MonitorConfig, board: Annunciator, reference: ProcessReference) -> None:
        self._config, self._board, self._reference = config, board, reference
        self._places = output_indices(reference.model, config.outputs)
        self._all_watched = self._places == list(range(len(reference.model.outputs)))
        self._isolation: Isolation | None = None
        self._rows: deque[tuple[float, float, list[float]]] = deque(maxlen=config.isolation_rows)
        self._incident = 0
        self._since: int | None = None
        self._reconstruction: Reconstruction | None = None
        self._output = self._cause = ""

    @property
    def state(self) -> SuspicionState:
        """A copy of all that is remembered."""
        return SuspicionState(
            packed([(time_min, input_value, *measured) for time_min, input_value, measured in self._rows]),
            self._incident,
            self._since,
            None if self._isolation is None else self._isolation.way,
            self._output,
            self._cause,
            None if self._reconstruction is None else self._reconstruction.state,
        )

    def restore(self, state: SuspicionState) -> None:
        """Go on where another of the same plant was when `state` was taken.

        Raises:
            ValueError: the state is damaged.
        """
        model = self._reference.model
        rows = unpacked(state.rows, 2 + len(model.outputs)).tolist()
        self._rows.extend((row[0], row[1], row[2:]) for row in rows)
        self._incident, self._since = state.incident, state.since
        if state.way is not None:
            self._compared().way = state.way
        if state.reconstruction is not None:
            self._reconstruct(state.output, state.cause, 0.0, ())
            assert self._reconstruction is not None
            self._reconstruction.restore(state.reconstruction)
        self._output, self._cause = state.output, state.cause

    def update(
        self, time_ns: int, input_value: float, values: list[float], units: list[str], stuck: list[bool]
    ) -> list[Publication]:
        """Take a row in, after its alarms.

        Args:
            time_ns: of the row.
            input_value: NaN if missing.
            values: of the outputs; NaN where missing.
            units: of the outputs.
            stuck: outputs whose sensors are stuck; their values are missing.
        """
        measured = self.add(time_ns / MINUTE_NS, input_value, values)
        time_min = time_ns / MINUTE_NS
        board = self._board
        if not board.has_unexplained and True not in stuck:  # as mostly
            self._reconstruction = self._since = None
            return []
        if True in stuck:
            self._reconstruct(self._config.outputs[stuck.index(True)], STUCK_SENSOR, time_min, list(self._rows)[:-1])
        elif self._cause == STUCK_SENSOR or not board.has_unexplained:
            self._reconstruction = None
        publications = self._reconstructed(time_ns, input_value, measured, values, units)
        if not board.has_unexplained:
            self._since = None
            return publications
        if self._since is None or board.incident != self._incident:
            self._since, self._incident = 0, board.incident
        self._since += 1
        if self._since in LOOKS:
            isolation = self._compared()
            suspects = isolation.suspects(-inf, self._since)
            told = [_told(item) for item in suspects if item.probability >= LEAST]
            publications += board.set_suspects(time_ns, told, stopped=isolation.stopped)
            self._follow(suspects[0])
        return publications

    def add(self, time_min: float, input_value: float, values: list[float]) -> list[float]:
        """Keep a row in which no alarm changes; returns its outputs of the model."""
        measured = self._measured(values)
        if self._rows and time_min <= self._rows[-1][0]:  # the plant's clock was set back
            self._rows.clear()
            self._isolation = None
        self._rows.append((time_min, input_value, measured))
        if self._isolation is not None:
            self._isolation.add(time_min, input_value, measured)
        return measured

    def _compared(self) -> Isolation:
        """With the newest rows in it. It is made at the first alarm: of thousands of plants few ever have one."""
        if self._isolation is None:
            reference = self._reference
            self._isolation = Isolation(reference.model, reference.noise, self._config.isolation_rows)
            for row in self._rows:
                self._isolation.add(*row)
        return self._isolation

    def _measured(self, values: list[float]) -> list[float]:
        """The outputs of the model; NaN for those that are not watched."""
        if self._all_watched:
            return values
        measured = [float("nan")] * len(self._reference.model.outputs)
        for place, value in zip(self._places, values, strict=True):
            measured[place] = value
        return measured

    def _follow(self, suspect: Suspect) -> None:
        """Begin, or cease, to reconstruct."""
        output = OUTPUTS.get(suspect.cause, "")
        if suspect.probability >= CONVINCED and output in self._config.outputs:
            self._reconstruct(output, suspect.cause, suspect.onset_min, self._rows)
        elif self._cause != STUCK_SENSOR:
            self._reconstruction = None

    def _reconstruct(self, output: str, cause: str, onset_min: float, rows: Iterable[Row]) -> None:
        """Tell after these rows what the sensor of an output should read, as long as that is not done already."""
        if self._reconstruction is None or (output, cause) != (self._output, self._cause):
            model, noise = self._reference.model, self._reference.noise
            place = model.output_names.index(output)
            self._reconstruction = Reconstruction(model, noise, place, rows, onset_min)
        self._output, self._cause = output, cause

    def _reconstructed(
        self, time_ns: int, input_value: float, measured: list[float], values: list[float], units: list[str]
    ) -> list[Publication]:
        if self._reconstruction is None:
            return []
        value, sd = self._reconstruction.update(time_ns / MINUTE_NS, input_value, measured)
        place = self._config.outputs.index(self._output)
        message = ReconstructionMessage(
            time_ns=time_ns, value=value, sd=sd, unit=units[place], measured=values[place], cause=self._cause
        )
        return [Publication(keys.key(self._config.plant, keys.RECONSTRUCTION, self._output), message)]


def _told(suspect: Suspect) -> SuspectedCause:
    if suspect.cause == UNKNOWN:
        return SuspectedCause(UNKNOWN, suspect.probability)
    return SuspectedCause(
        suspect.cause,
        suspect.probability,
        suspect.profile,
        suspect.size,
        suspect.size_sd,
        UNITS[suspect.cause],
        round(suspect.onset_min * MINUTE_NS),
        suspect.onset_sd_min,
        suspect.kind,
    )
