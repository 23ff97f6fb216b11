"""Runs of the monitor over records that a test makes."""

from dataclasses import dataclass, field

import numpy as np

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, ChartPoint, Incident, Suspect
from reactorwatch.records.record import to_time_ns

from .samples import Rows, leaking_run, samples


@dataclass
class Watched:
    """A monitor that was run over a record, and its output."""

    monitor: Monitor
    published: list[Publication] = field(default_factory=list)

    @property
    def alarms(self) -> list[Alarm]:
        """Every change of an alarm."""
        return [item.message for item in self.published if isinstance(item.message, Alarm)]

    @property
    def suspected(self) -> list[Incident]:
        """Every incident as it was published with other suspects than before."""
        newest: dict[int, list[Suspect]] = {}
        found = []
        for item in self.published:
            incident = item.message
            if isinstance(incident, Incident) and incident.suspects:
                if list(incident.suspects) != newest.get(incident.number):
                    found.append(incident)
                newest[incident.number] = list(incident.suspects)
        return found

    @property
    def raised(self) -> list[tuple[str, float]]:
        """(name, minute) of every alarm that was raised."""
        return [(alarm.alarm, round(alarm.time_ns / 60e9, 3)) for alarm in self.alarms if alarm.event == "raised"]

    def points(self, chart: str) -> list[ChartPoint]:
        """Of a chart, such as `shewhart/T`."""
        suffix = f"/chart/{chart}"
        return [
            item.message
            for item in self.published
            if isinstance(item.message, ChartPoint) and item.key.endswith(suffix)
        ]


def watched(
    time_min: Rows, columns: dict[str, Rows], config: MonitorConfig | None = None, *, compiled: bool = True
) -> Watched:
    """Run a monitor over a record.

    Args:
        time_min: times, in minutes.
        columns: values of the signals.
        config: settings; None: the default without isolation.
        compiled: normal rows take one compiled step; False: every row passes the stages one by one.
    """
    run = Watched(Monitor(config or MonitorConfig(isolation=False), 0))
    if not compiled:
        run.monitor.pipeline.evaluation.find_ordinary = lambda *_: False  # type: ignore[method-assign]
    for message in samples(time_min, columns):
        run.published += run.monitor.on_message(message, 0)
    run.published += run.monitor.finish()
    return run


def sound_run(span_min: float, seed: int) -> tuple[Rows, dict[str, Rows]]:
    """A run without a fault."""
    return leaking_run(0.0, 1.0, span_min, seed)


def minute_ns(minute: float) -> int:
    """Time of a row."""
    return to_time_ns(float(np.round(minute, 1)))
