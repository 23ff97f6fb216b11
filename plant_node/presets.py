"""Named runs: the four records of the work that this project starts from, a fault free one and three with a fault.

They differ in their fault alone: same input, same noise, same length, and with the same seed the same rows until the
fault sets in, two hours of watching after the hundred minutes that a monitor learns from. Their flow goes up to 105
l/min and not, as elsewhere, to 111, where the slower reaction would go out.

Input leakage: the input is the coolant flow, so coolant that the valve lets through leaks out on its way to the jacket,
while `qc` stays what was commanded. Of internal parameters, the two that change in a real plant: heat transfer, as the
jacket fouls, and the reaction rate, as a catalyst loses its activity. They differ in kind, too. Less heat transfer
warms the reactor as the leakage does, and can be told from it only by how it depends on the flow; a slower reaction
cools it. (The activation energy would be a second name for the rate: about one temperature a change of E/R is one of
k0.)

The sizes move the operating point by several standard deviations of the thermometer, and leave the plant on its
operating branch.
"""

from dataclasses import dataclass
from typing import Any

ONSET_MIN = 220.0
DURATION_MIN = 400.0


@dataclass(frozen=True)
class Preset:
    """Settings of the plant that go together.

    Attributes:
        name: as in `--preset input-leakage`.
        meaning: one line for people.
        faults: see `PlantConfig.faults`.
    """

    name: str
    meaning: str
    faults: tuple[str, ...]

    @property
    def settings(self) -> dict[str, Any]:
        """Of `PlantConfig`, by name, in the form that a settings file has."""
        return {
            "duration_min": DURATION_MIN,
            "scenario": {"kind": "random-steps", "low": 85.0, "high": 105.0, "hold_min": 1.0},
            "noise_sd": {"C": 0.002, "T": 0.3, "qc": 0.0},
            "faults": list(self.faults),
        }


PRESETS: tuple[Preset, ...] = (
    Preset("fault-free", "nothing is wrong", ()),
    Preset("input-leakage", "a tenth of the coolant leaks out", (f"coolant_flow:step:-0.1@{ONSET_MIN:g}min",)),
    Preset("heat-transfer", "half of the heat transfer is gone", (f"heat_transfer:step:-0.5@{ONSET_MIN:g}min",)),
    Preset("reaction-rate", "the reaction is a tenth slower", (f"reaction_rate:step:-0.1@{ONSET_MIN:g}min",)),
)
