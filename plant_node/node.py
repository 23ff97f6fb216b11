"""The plant as a node: rows at their pace, commands, health. Pure: time is an argument.

Plant time runs `speed` times as fast as the wall clock, from the first tick on. A row is due at its plant time; if the
machine cannot keep up, rows are late but complete, and the lag is reported.
"""

from collections import Counter
from collections.abc import Callable
from math import isinf

from plant_node.config import PlantConfig
from plant_node.core import FaultChange, Plant, Row
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode_command
from reactorwatch.contract.messages_pb2 import (
    ClearFault,
    CommandReply,
    Fault,
    Health,
    InjectFault,
    Quality,
    Sample,
    SetInput,
)
from reactorwatch.errors import InputError
from reactorwatch.process.fault import parse_fault
from reactorwatch.records.record import MINUTE_NS, to_time_ns
from reactorwatch.runtime.bus import Node
from reactorwatch.version import version

NODE = "plant"
COMMANDS: dict[str, type[SetInput | InjectFault | ClearFault]] = {
    "set_input": SetInput,
    "inject_fault": InjectFault,
    "clear_fault": ClearFault,
}
"""The message type of each command."""

BATCH = 200  # rows published before the loop serves commands again


class PlantNode(Node):
    """Publishes rows of the plant when they are due.

    Args:
        plant: the simulated plant, at its first row.
        config: settings of the plant.
        log: called with a line of text when something happens.
    """

    def __init__(self, plant: Plant, config: PlantConfig, log: Callable[[str], None]) -> None:
        self._plant = plant
        self._config = config
        self._log = log
        self._started_ns: int | None = None
        self._zero_ns = config.zero_ns
        self._health_due_ns = 0
        self._lag_logged_ns = -MINUTE_NS
        self._had_trouble = False
        self._lag_ns = 0
        self._published = 0
        self._received = 0
        self._refused: Counter[str] = Counter()

    @property
    def finished(self) -> bool:
        """True when all rows of the run are published."""
        return self._config.rows is not None and self._plant.number >= self._config.rows

    def next_tick_ns(self) -> int:
        """Time at which the next row or health message is due."""
        if self._started_ns is None:
            return 0
        return min(self._row_due_ns(self._started_ns), self._health_due_ns)

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Publish the rows that are due, at most a batch, and health if it is due."""
        if self._started_ns is None:
            self._started_ns = self._health_due_ns = now_ns
            self._zero_ns = now_ns if self._zero_ns is None else self._zero_ns
        publications: list[Publication] = []
        for _ in range(BATCH):
            due_ns = self._row_due_ns(self._started_ns)
            if self.finished or due_ns > now_ns:
                break
            self._lag_ns = 0 if isinf(self._config.speed) else now_ns - due_ns
            publications += self._publications(self._plant.next_row())
        self._log_problems(now_ns)
        self._published += len(publications)
        if now_ns >= self._health_due_ns:
            self._health_due_ns = now_ns + round(self._config.health_period_s * 1e9)
            publications.append(self._health(now_ns, "holding" if self._plant.trouble else "running"))
        return publications

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Execute a command from the next row on, or reply with the reason for refusing it."""
        self._received += 1
        try:
            text = self._execute(question)
        except (InputError, DecodeError) as error:
            self._refused[error.reason if isinstance(error, DecodeError) else "command"] += 1
            return CommandReply(accepted=False, text=str(error)), []
        self._log(text)
        return CommandReply(accepted=True, text=text), []

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Publish the last health message."""
        return [self._health(now_ns, "stopped")]

    def _row_due_ns(self, started_ns: int) -> int:
        return started_ns + round(self._plant.time_min * 60e9 / self._config.speed)

    def _execute(self, question: Encoded) -> str:
        _, command = decode_command(question, COMMANDS)
        when = f"from {self._plant.time_min:g} min on"
        match command:
            case SetInput():
                self._plant.set_input(command.signal, command.value)
                text = f"{command.signal} = {command.value:g} {self._plant.units[command.signal]} {when}"
                return text if self._plant.mode == "open loop" else f"{text}, on {self._plant.mode}"
            case InjectFault():
                fault = parse_fault(command.specification, self._plant.effects)
                return f"fault {self._plant.inject(fault)} is in the plant"
            case ClearFault():
                cleared = ", ".join(str(item) for item in self._plant.clear(command.cause))
                return f"fault {cleared} is taken away {when}"
        raise AssertionError("COMMANDS has no other types")

    def _publications(self, row: Row) -> list[Publication]:
        time_ns = self._time_ns(row.time_min)
        quality = Quality.QUALITY_GOOD if row.good else Quality.QUALITY_BAD
        publications = [self._fault(change, time_ns) for change in row.changes]
        for signal, value in row.readings.items():
            unit = self._plant.units[signal]
            sample = Sample(time_ns=time_ns, sequence=row.number, value=value, unit=unit, quality=quality)
            publications.append(Publication(keys.key(self._config.name, keys.SAMPLE, signal), sample))
        return publications

    def _fault(self, change: FaultChange, time_ns: int) -> Publication:
        cause = change.specification.effect.name
        self._log(f"fault {change.specification} {'sets in' if change.active else 'is gone'}")
        fault = Fault(
            time_ns=time_ns,
            cause=cause,
            specification=str(change.specification),
            active=change.active,
            onset_ns=self._time_ns(change.onset_min),
        )
        return Publication(keys.key(self._config.name, keys.FAULT, cause), fault)

    def _health(self, now_ns: int, phase: str) -> Publication:
        self._published += 1
        started_ns = now_ns if self._started_ns is None else self._started_ns
        health = Health(
            time_ns=now_ns,
            node=NODE,
            version=version(),
            phase=phase,
            uptime_s=(now_ns - started_ns) / 1e9,
            received=self._received,
            refused=self._refused.total(),
            refused_by_reason=self._refused,
            lag_ms=self._lag_ns / 1e6,
            published=self._published,
            rows=self._plant.number,
        )
        return Publication(keys.key(self._config.name, keys.HEALTH, NODE), health)

    def _log_problems(self, now_ns: int) -> None:
        trouble = self._plant.trouble
        if trouble is not None and not self._had_trouble:
            self._log(f"{trouble}: the state is held, samples are marked bad")
        self._had_trouble = trouble is not None
        if self._lag_ns > 1e9 and now_ns - self._lag_logged_ns >= MINUTE_NS:  # a second, once a minute
            self._lag_logged_ns = now_ns
            self._log(f"behind its pace by {self._lag_ns / 1e9:.1f} s; no row is left out")

    def _time_ns(self, time_min: float) -> int:
        assert self._zero_ns is not None, "set at the first tick"
        return to_time_ns(time_min, self._zero_ns)
