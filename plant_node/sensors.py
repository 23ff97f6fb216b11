"""What a sensor makes of the value that is there: noise, and the steps of its converter."""

from dataclasses import dataclass

from plant_node.noise import standard_normal


@dataclass(frozen=True)
class Sensor:
    """Measures one signal.

    Attributes:
        signal: its name.
        noise_sd: standard deviation of the noise, white and normal, in the signal's unit.
        resolution: readings are multiples of this, in the signal's unit; 0: of nothing.
        seed: of the noise.
    """

    signal: str
    noise_sd: float
    resolution: float
    seed: int

    def reading(self, value: float, row: int) -> float:
        """What it shows in a row of the run, counted from 0, where the true value is `value`."""
        if self.noise_sd:
            value += self.noise_sd * standard_normal(self.seed, f"sensor {self.signal}", row)
        if self.resolution:
            value = round(value / self.resolution) * self.resolution
        return value
