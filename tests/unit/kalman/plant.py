"""Records of the simulated reactor, and a filter of its sensors' noise."""

import numpy as np

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf_step import NoiseLevels

SENSORS = NoiseLevels((0.002, 0.3), (0.0, 0.0))


def record_of(rows: int, **settings: object) -> tuple[Array, Array, Array]:
    """Times in minutes, coolant flow, and measurements of concentration and temperature."""
    record = simulate_record(PlantConfig(**settings), rows)  # type: ignore[arg-type] # settings by name
    return record.time_min, record.columns["qc"], np.column_stack([record.columns["C"], record.columns["T"]])
