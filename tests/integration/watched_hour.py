"""An hour of a plant with faults, monitored and recorded within this process, on a simulated clock.

The plant is sixty times as fast as the clock. A quarter of an hour the monitor learns; a leak sets in at 30 minutes; an
operator acknowledges and shelves what is raised; the thermometer is silent for two minutes; and at 50 minutes
nothing comes for longer than the timeout on the clock of receipt, so the monitor raises a silence without a sample.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.cli.processes import settings_text
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import AlarmCommand, ShelveAlarm
from recorder.tools.player import samples_of
from tests.unit.recorder.recording import SECOND, Fed, recorder

ROWS = 600
ROW_NS = SECOND // 10
START_NS = 1_750_000_000 * SECOND
FAULTS = ("coolant_flow:step:-0.08@30min",)
MONITOR = MonitorConfig(training_min=15.0)
HELD_UP_NS = 20 * SECOND


@dataclass
class Hour:
    """What happens while it lasts."""

    fed: Fed
    monitor: Monitor

    def pass_time(self, span_ns: int) -> None:
        """Let the monitor and the recorder do what falls due."""
        end_ns = self.fed.now_ns + span_ns
        while (due_ns := self.monitor.next_tick_ns()) <= end_ns:
            self.fed.pass_time(max(0, due_ns - self.fed.now_ns))
            self.record(self.monitor.on_tick(self.fed.now_ns))
        self.fed.pass_time(end_ns - self.fed.now_ns)

    def record(self, publications: Iterable[Publication]) -> None:
        """Publish to the recorder."""
        self.fed.receive(publications, 0)

    def publish(self, publication: Publication) -> None:
        """Publish to both."""
        self.record([publication])
        message = Encoded(*encode(publication)[:3], self.fed.now_ns)
        self.record(self.monitor.on_message(message, self.fed.now_ns))

    def ask(self, name: str, command: AlarmCommand | ShelveAlarm) -> None:
        """Have an operator act."""
        reply, publications = self.monitor.on_command(
            encode(Publication(keys.key("cstr", keys.COMMAND, name), command)),  # type: ignore[arg-type]
            self.fed.now_ns,
        )
        assert reply.accepted, reply.text
        self.record(publications)


def settings() -> dict[str, str]:
    """What the recording says of the settings, as that of `up` does."""
    return {"settings": settings_text({"monitor": MONITOR})}


def record_hour(out: Path, *, restart_at: int | None = None, **recorder_settings: Any) -> Fed:
    """Record the hour; the recorder is still running.

    Args:
        out: file or folder.
        restart_at: row before which the monitor is started anew.
        recorder_settings: of the recorder.
    """
    hour = Hour(recorder(out, START_NS, about=settings(), **recorder_settings), Monitor(MONITOR, START_NS))
    rows: dict[int, list[Publication]] = {}
    for publication in samples_of(simulate_record(PlantConfig(seed=5, faults=FAULTS), ROWS), "cstr", START_NS):
        rows.setdefault(publication.message.time_ns, []).append(publication)
    for number, row in enumerate(rows.values()):
        if number == restart_at:
            hour.monitor = Monitor(MONITOR, hour.fed.now_ns)
        hour.pass_time(HELD_UP_NS if number == 500 else ROW_NS)
        for publication in row:
            if not (400 <= number < 420 and publication.key.endswith("/T")):
                hour.publish(publication)
        if number == 340 and restart_at is None:
            hour.ask("acknowledge", AlarmCommand(incident=1, by="Ada", comment="seen"))
            hour.ask("shelve", ShelveAlarm(alarm="shewhart/T", by="Ada", minutes=7.5))
    hour.record(hour.monitor.on_stop(hour.fed.now_ns))
    return hour.fed
