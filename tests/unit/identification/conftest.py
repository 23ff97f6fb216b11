"""Records that several identification tests use."""

from pathlib import Path

import numpy as np
import pytest

from tests.unit.identification.truth import Daisy, NoisyPlant, oscillating_plant


@pytest.fixture(scope="session")
def daisy(daisy_csv: Path) -> Daisy:
    return Daisy(*np.loadtxt(daisy_csv, delimiter=",", skiprows=1).T)


@pytest.fixture(scope="session")
def noisy_plant() -> NoisyPlant:
    return oscillating_plant()
