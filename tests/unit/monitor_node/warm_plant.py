"""A plant whose feed was 2 K warmer all along, and its monitor, whose diagnosis of the training took three minutes."""

from collections.abc import Sequence
from dataclasses import dataclass

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.diagnosis_worker import find_deviations
from monitor_node.learn.training_diagnosis import Finding
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Baseline

from .samples import samples

CONFIG = MonitorConfig(training_min=40.0)
GIVEN = MonitorConfig(training_min=40.0, diagnose_training=False)
TRAINED = 3 * 400
"""Number of the sample that ends the training."""
LATE = TRAINED + 3 * 30
"""Number of the sample at which a finding comes that took three minutes."""


def plant(*faults: str, span_min: float = 60.0, seed: int = 3) -> list[Encoded]:
    record = simulate_record(PlantConfig(seed=seed, faults=faults), int(10 * span_min))
    return list(samples(record.time_min, record.columns))


def publish(monitor: Monitor, messages: Sequence[Encoded]) -> list[Publication]:
    return [item for message in messages for item in monitor.on_message(message, 0)]


def changes(publications: list[Publication]) -> list[Baseline]:
    return [item.message for item in publications if isinstance(item.message, Baseline)]


@dataclass
class Run:
    """A plant that was 2 K warmer at its feed all along, watched by a monitor whose diagnosis took three minutes."""

    messages: list[Encoded]
    finding: Finding
    published: list[Publication]
    pending: bytes
    changed: bytes


def watch_warm_plant() -> Run:
    messages = plant("feed_temperature:constant:2")
    monitor = Monitor(CONFIG, 0)
    published = publish(monitor, messages[: TRAINED + 3])
    assert monitor.pipeline.baselines.diagnosis_job is not None
    finding, pending = find_deviations(monitor.pipeline.baselines.diagnosis_job), monitor.to_bytes()
    published += publish(monitor, messages[TRAINED + 3 : LATE])
    monitor.pipeline.baselines.on_finding(finding)
    published += publish(monitor, messages[LATE : LATE + 60])
    changed = monitor.to_bytes()
    published += publish(monitor, messages[LATE + 60 :])
    return Run(messages, finding, published, pending, changed)
