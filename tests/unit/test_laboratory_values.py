"""An output that has values in few rows, as a laboratory's: 60 in 300 min are diagnosed and watched."""

import numpy as np
import pytest

import reactorwatch as rw
from plant_node.config import PlantConfig
from plant_node.record import simulate_record

ROWS, EVERY = 3000, 50
"""Rows each 6 s, and those from one value of the concentration to the next."""


def laboratory_record(*faults: str, seed: int = 7, rows: int = ROWS) -> rw.Record:
    record = simulate_record(PlantConfig(seed=seed, faults=faults), rows)
    signals = dict(record.columns)
    signals["C"] = np.where(np.arange(rows) % EVERY == 3, signals["C"], np.nan)
    return rw.Record(time_min=record.time_min, signals=signals, process="cstr")


def test_a_sound_plant_with_laboratory_values_is_right() -> None:
    assert rw.diagnose(laboratory_record()).verdict == "nominal"


@pytest.mark.parametrize(
    ("cause", "size", "within_min"),
    [("concentration_bias", 0.006, 5.0), ("concentration_gain", -0.05, 5.0), ("feed_concentration", 0.03, 0.1)],
)
def test_faults_are_found_by_laboratory_values_or_beside_them(cause: str, size: float, within_min: float) -> None:
    """The first two act on the laboratory alone: their onset is known to the time between two values."""
    found = rw.diagnose(laboratory_record(f"{cause}:step:{size}@150min"))
    assert found.verdict == "named"
    first = found.causes[0]
    assert first.cause == cause
    assert first.parameters["size"].value == pytest.approx(size, rel=0.25)
    assert first.parameters["onset"].value == pytest.approx(150.0, abs=within_min)


def test_laboratory_values_are_watched_from_the_usual_length_of_a_training_on() -> None:
    found = rw.backtest(laboratory_record("concentration_bias:step:0.01@200min", seed=5))
    assert found.trained_until_min == pytest.approx(100.0, abs=0.5)
    first = found.alarms[0]
    assert 200.0 < first.raised_min < 260.0
    assert first.alarm.endswith("/C")
    assert first.suspect[0].cause == "concentration_bias"


def test_a_sound_laboratory_is_neither_silent_nor_stuck() -> None:
    assert not rw.backtest(laboratory_record(seed=8, rows=2 * ROWS)).alarms
