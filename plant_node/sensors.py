"""Sensors: from a true value to a reading, with noise and quantisation."""

from dataclasses import dataclass
from math import hypot, sqrt

from plant_node.noise import standard_normal


@dataclass(frozen=True)
class Sensor:
    """Measures one signal.

    Attributes:
        signal: name of the signal.
        noise_sd: standard deviation of the white normal noise, in the signal's unit.
        resolution: quantisation step, in the signal's unit; 0: none.
        seed: seed of the noise.
    """

    signal: str
    noise_sd: float
    resolution: float
    seed: int

    def reading(self, value: float, row: int, beyond: float = 0.0) -> float:
        """Reading in a row of the run.

        Args:
            value: true value.
            row: index of the row, from 0.
            beyond: variance of the noise beyond the sensor's own.
        """
        if self.noise_sd or beyond:
            sd = hypot(self.noise_sd, sqrt(beyond)) if beyond else self.noise_sd
            value += sd * standard_normal(self.seed, f"sensor {self.signal}", row)
        if self.resolution:
            value = round(value / self.resolution) * self.resolution
        return value
