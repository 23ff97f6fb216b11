"""Sensors: from a true value to a reading, with noise and quantisation."""

from dataclasses import dataclass

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

    def reading(self, value: float, row: int) -> float:
        """Reading in a row of the run, counted from 0, at a true value."""
        if self.noise_sd:
            value += self.noise_sd * standard_normal(self.seed, f"sensor {self.signal}", row)
        if self.resolution:
            value = round(value / self.resolution) * self.resolution
        return value
