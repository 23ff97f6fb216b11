"""Rows of a plant and their columns; a plant whose sensors have no noise."""

import numpy as np

from plant_node.core import Plant, Row
from reactorwatch.arrays import Array

QUIET = {"C": 0.0, "T": 0.0, "qc": 0.0}


def rows(of: Plant, count: int) -> list[Row]:
    return [of.next_row() for _ in range(count)]


def column(found: list[Row], signal: str) -> Array:
    return np.array([row.readings[signal] for row in found])
