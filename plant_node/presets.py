"""Named runs: the four records of the study that this project starts from, one fault-free and three with a fault.

They differ in their fault only: same input, same noise, same length, and with the same seed the same rows until the
fault sets in, two hours of monitoring after the hundred minutes of training. The flow goes up to 105 l/min instead of
111, where the slower reaction would extinguish.

Input leakage: the input is the coolant flow, so coolant leaks between the valve and the jacket while `qc` remains the
command. Of internal parameters, the two that change in a real plant: heat transfer, as the jacket fouls, and the
reaction rate, as a catalyst deactivates. They differ in kind, too. Less heat transfer warms the reactor as the leakage
does, and differs from it only in its dependence on the flow; a slower reaction cools it. (The activation energy would
be a second name for the rate: near one temperature a change of E/R is one of k0.)

The sizes move the operating point by several standard deviations of the thermometer, and keep the plant on its
operating branch.
"""

from dataclasses import dataclass
from typing import Any

ONSET_MIN = 220.0
DURATION_MIN = 400.0


@dataclass(frozen=True)
class Preset:
    """A named set of settings of the plant.

    Attributes:
        name: name, as in `--preset input-leakage`.
        meaning: a one-line description.
        faults: see `PlantConfig.faults`.
    """

    name: str
    meaning: str
    faults: tuple[str, ...]

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of `PlantConfig` by name, as in a settings file."""
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
