"""Rows of a plant with a fault, for the isolation."""

from math import inf
from typing import Any

from monitor_node.causes.window import Row
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.kalman.ekf_step import NoiseLevels

SENSORS = NoiseLevels((0.002, 0.3), (0.0, 0.0))
"""The plant's default noise."""

ONSET_MIN = 60.03


def rows_of(*faults: str, seed: int, after_min: float, begin_min: float = 0.0, **settings: Any) -> list[Row]:
    """What a plant publishes until so long after `ONSET_MIN`.

    Args:
        faults: as cause:profile:size; the onset is added where there is none.
        seed: of the input and the noise.
        after_min: how long after the onset it ends.
        begin_min: where it begins.
        settings: of the plant.
    """
    said = tuple(item if "@" in item else f"{item}@{ONSET_MIN}min" for item in faults)
    config = PlantConfig(seed=seed, faults=said, **settings)
    record = simulate_record(config, int((ONSET_MIN + after_min) / config.period_min) + 1)
    columns = (record.time_min, record.columns["qc"], record.columns["C"], record.columns["T"])
    found: list[Row] = [(t, (u,), (c, T)) for t, u, c, T in zip(*(column.tolist() for column in columns), strict=True)]
    return [row for row in found if begin_min <= row[0] < inf]
