"""Cases of the fault bank: faults, sizes and onsets.

Every cause that the monitor compares (see `isolation.isolation.causes`) sets in as a step, and three of them as a
ramp too, each in three sizes: small is about the smallest that the oracle (see `oracle`) finds within an hour, medium
eight times as much, and large ten times that: as gross as the report's method needs. Large faults that cool the reactor
put it out: that is noted, not avoided.

Every case has a seed of its own, so the fault-free rows before its onset are like no other case's.
"""

from dataclasses import dataclass

import numpy as np

PERIOD_MIN = 0.1
TRAINING_MIN = 100.0
ONSET_MIN = 300.0
"""The earliest onset; the latest is `ONSET_SPAN_MIN` later."""

ONSET_SPAN_MIN = 10.0
AFTER_MIN = 150.0
"""Duration of a run after the onset; a fault not found by then is not detected."""

RAMP_MIN = 100.0
"""Duration of a ramp from its onset to its size."""

GRADES = ("small", "medium", "large")
BOTH, RISING, FALLING = (1, -1), (1,), (-1,)


@dataclass(frozen=True)
class Fault:
    """A fault of the bank."""

    cause: str  # name of an effect of the catalogue
    profile: str  # `step` or `ramp`
    sizes: tuple[float, float, float]  # small, medium and large, in the effect's unit, above 0
    signs: tuple[int, ...] = BOTH  # signs that its sizes take in turn, from seed to seed

    @property
    def name(self) -> str:
        """Name of the fault in tables."""
        return self.cause if self.profile == "step" else f"{self.cause} {self.profile}"


BANK: tuple[Fault, ...] = (
    Fault("feed_temperature", "step", (0.05, 0.4, 4.0)),
    Fault("feed_concentration", "step", (0.0003, 0.0025, 0.024)),
    Fault("feed_flow", "step", (0.0008, 0.0065, 0.06)),
    Fault("reaction_rate", "step", (0.0016, 0.013, 0.1)),
    Fault("activation_energy", "step", (0.00007, 0.00055, 0.004)),
    Fault("reaction_heat", "step", (0.0003, 0.0025, 0.024)),
    # At 100 l/min the coolant leaves with all but a thousandth of the contents' temperature: more heat transfer does
    # next to nothing, whatever its size.
    Fault("heat_transfer", "step", (0.06, 0.25, 0.6), FALLING),
    Fault("heat_loss", "step", (0.00035, 0.0028, 0.028), RISING),
    Fault("coolant_temperature", "step", (0.05, 0.4, 4.0)),
    Fault("coolant_flow", "step", (0.00055, 0.0045, 0.04)),
    Fault("temperature_bias", "step", (0.065, 0.55, 5.0)),
    Fault("concentration_bias", "step", (0.00045, 0.0036, 0.034)),
    Fault("concentration_gain", "step", (0.0046, 0.038, 0.36)),
    Fault("heat_transfer", "ramp", (0.15, 0.35, 0.7), FALLING),
    Fault("reaction_rate", "ramp", (0.005, 0.025, 0.1), FALLING),
    Fault("temperature_bias", "ramp", (0.2, 1.0, 8.0)),
)

TWINS: dict[str, frozenset[str]] = {
    "feed_temperature": frozenset(
        {"feed_concentration", "reaction_heat", "heat_loss", "coolant_temperature", "coolant_flow"}
    ),
    "feed_concentration": frozenset({"feed_temperature", "feed_flow", "reaction_heat", "heat_loss", "coolant_flow"}),
    "feed_flow": frozenset({"feed_concentration"}),
    "reaction_rate": frozenset({"activation_energy"}),
    "activation_energy": frozenset({"reaction_rate"}),
    "reaction_heat": frozenset({"feed_temperature", "feed_concentration", "heat_loss", "coolant_flow"}),
    "heat_loss": frozenset(
        {"feed_temperature", "feed_concentration", "reaction_heat", "coolant_temperature", "coolant_flow"}
    ),
    "coolant_temperature": frozenset({"feed_temperature", "heat_loss", "coolant_flow"}),
    "coolant_flow": frozenset(
        {"feed_temperature", "feed_concentration", "reaction_heat", "heat_loss", "coolant_temperature"}
    ),
}
"""Causes that imitate each other: of what a small step of one does to both measurements in `AFTER_MIN`, a step of the
other, of the best size, leaves less than a hundredth unexplained (of the sum of squares, each over its noise). A twin
is never counted as the right suspect; how often a twin came first is printed beside it."""


@dataclass(frozen=True)
class Case:
    """One run of the bank."""

    fault: Fault  # the fault
    grade: str  # one of `GRADES`
    size: float  # size with its sign, in the effect's unit
    onset_min: float  # onset in minutes of the plant
    seed: int  # seed of the input and the noise

    @property
    def specification(self) -> str:
        """Specification of the fault for the plant."""
        text = f"{self.fault.cause}:{self.fault.profile}:{self.size!r}@{self.onset_min!r}min"
        return f"{text},end={self.onset_min + RAMP_MIN!r}min" if self.fault.profile == "ramp" else text

    @property
    def rows(self) -> int:
        """Number of rows of the run."""
        return int((self.onset_min + AFTER_MIN) / PERIOD_MIN) + 1


def cases(seeds: int) -> list[Case]:
    """Cases of all faults in all sizes."""
    found = []
    for place, fault in enumerate(BANK):
        for grade, size in zip(GRADES, fault.sizes, strict=True):
            for number in range(seeds):
                seed = 100_000 + 10_000 * place + 1_000 * GRADES.index(grade) + number
                onset_min = ONSET_MIN + ONSET_SPAN_MIN * float(np.random.default_rng(seed).random())
                signed = size * fault.signs[number % len(fault.signs)]
                found.append(Case(fault, grade, signed, round(onset_min, 6), seed))
    return found
