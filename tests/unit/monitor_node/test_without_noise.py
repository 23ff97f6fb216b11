"""A plant whose sensors have no noise is monitored, though no smallest level was stated."""

import pytest

from monitor_node.config import MonitorConfig
from monitor_node.replay.backtest import run
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import encode
from recorder.tools.player import samples_of


@pytest.mark.parametrize("noise_sd", [{"C": 0.0, "T": 0.0}, {"C": 0.0, "T": 0.3}, {"C": 0.002, "T": 0.0}])
def test_a_leak_is_seen_without_noise_and_without_a_smallest_level(noise_sd: dict[str, float]) -> None:
    plant = PlantConfig(seed=5, noise_sd=noise_sd, faults=("coolant_flow:step:-0.05@50min",))
    messages = (encode(item) for item in samples_of(simulate_record(plant, 600), plant.name))
    result = run(messages, MonitorConfig(smallest_sd={}, training_min=40, isolation=False, diagnose_training=False))
    assert min(alarm.raised_ns for alarm, _ in result.raised_alarms) / 60e9 == pytest.approx(50.0, abs=2.0)
