"""Records of a plant with something wrong, for the diagnosis."""

import numpy as np

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.diagnosis.run import Run
from reactorwatch.records.record import Record


def record_of(*faults: str, seed: int = 1, rows: int = 3000) -> Record:
    """Record of a plant whose input steps every minute."""
    return simulate_record(PlantConfig(seed=seed, faults=faults), rows)


def make_run(*faults: str, seed: int = 1, rows: int = 3000) -> Run:
    """The same as a run."""
    record = record_of(*faults, seed=seed, rows=rows)
    measured = np.stack([record.columns["C"], record.columns["T"]], axis=1)
    return Run(record.time_min, record.columns["qc"][:, None], measured)
