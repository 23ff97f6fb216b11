"""Fleets of a test: plants, monitors, and the output of each plant's own monitor."""

from collections.abc import Iterable
from typing import Any

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet import ANY, WHOLE, FleetMonitor, PlantKind, Shard
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, Health

from .samples import leaking_run, samples

PLANTS = "reactor/*"
SECOND_NS = 1_000_000_000
QUICK = MonitorConfig(training_min=20.0, isolation=False, diagnose_training=False)


def of_plant(plant: str, messages: Iterable[Encoded]) -> list[Encoded]:
    """The messages of another plant."""
    return [message._replace(key=message.key.replace("reactor/cstr/", f"reactor/{plant}/")) for message in messages]


def run_of(plant: str, seed: int, *, leak_min: float | None = None, span_min: float = 40.0) -> list[Encoded]:
    """What a plant publishes; with a leak of a fifth from a minute on, or without."""
    size = 0.0 if leak_min is None else -0.2
    return of_plant(plant, samples(*leaking_run(size, leak_min or 1.0, span_min, seed)))


def row_by_row(runs: Iterable[list[Encoded]]) -> list[Encoded]:
    """The runs of plants that run at the same time: a row of the first, a row of the second, and so on."""
    rows = zip(*([run[at : at + 3] for at in range(0, len(run), 3)] for run in runs), strict=True)
    return [message for each in rows for row in each for message in row]


def fleet(config: MonitorConfig = QUICK, shard: Shard = WHOLE, **callbacks: Any) -> FleetMonitor:
    """A monitor of all plants, or of a shard."""
    return FleetMonitor([PlantKind(ANY, config, None)], 0, shard, **callbacks)


def stage_by_stage(config: MonitorConfig, plant: str = "x", *, points: bool = False) -> Monitor:
    """Monitor whose rows all pass the stages one by one, as events do."""
    monitor = Monitor(msgspec.structs.replace(config, plant=plant), 0, points=points)
    monitor.pipeline.evaluation.find_ordinary = lambda *_: False  # type: ignore[method-assign]
    return monitor


def alone(plant: str, messages: Iterable[Encoded], config: MonitorConfig = QUICK) -> list[Publication]:
    """Publications of the plant's own monitor, stage by stage."""
    monitor = stage_by_stage(config, plant)
    return [said for message in messages for said in monitor.on_message(message, 0)]


def of(plant: str, said: Iterable[Publication]) -> list[Publication]:
    """The messages about a plant, without the health of its monitor."""
    begin = f"{keys.ROOT}/{plant}/"
    return [item for item in said if item.key.startswith(begin) and not isinstance(item.message, Health)]


def alarms(said: list[Publication]) -> list[tuple[str, str, int]]:
    """Key, event and time of each alarm."""
    return [(i.key, i.message.event, i.message.time_ns) for i in said if isinstance(i.message, Alarm)]
