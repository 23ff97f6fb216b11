"""Suspects: causes with their posterior probabilities, from the evidence of each hypothesis."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, nan
from typing import NamedTuple

from reactorwatch.process.effect import Effect, SensorEffect

UNKNOWN, SENSOR, PROCESS = "unknown", "sensor", "process"


@dataclass(frozen=True)
class Suspect:
    """A cause with its probability, and its size and onset if it is the cause.

    Attributes:
        cause: its name in the catalogue, or `UNKNOWN`.
        profile: `step` or `ramp`; empty if unknown.
        probability: posterior probability; those of all suspects sum to 1.
        size: size in the effect's unit; for a ramp, in the last row.
        size_sd: standard deviation of the size.
        onset_min: onset in minutes.
        onset_sd_min: standard deviation of the onset.
        kind: `sensor` or `process`; `UNKNOWN` if unknown.
    """

    cause: str
    profile: str
    probability: float
    size: float
    size_sd: float
    onset_min: float
    onset_sd_min: float
    kind: str


class Evidence(NamedTuple):
    """A cause with a profile, and its evidence.

    Attributes:
        effect: effect of the cause.
        log_evidence: logarithm of its likelihood ratio to no fault, integrated over sizes and onsets.
        profile: see `Suspect`.
        size: see `Suspect`.
        size_sd: see `Suspect`.
        onset_min: see `Suspect`.
        onset_sd_min: see `Suspect`.
    """

    effect: Effect
    log_evidence: float
    profile: str
    size: float
    size_sd: float
    onset_min: float
    onset_sd_min: float


def rank_suspects(items: Sequence[Evidence], none: float, nothing: float = 0.0) -> list[Suspect]:
    """Compute the probability of each cause, most likely first; its size and onset are those of its likeliest profile.

    Args:
        items: evidence of each cause with each profile; at least one.
        none: logarithm of the evidence that the cause is none of these.
        nothing: logarithm of the evidence that nothing is wrong. Both are the suspect `UNKNOWN`.
    """
    top = max(*(item.log_evidence for item in items), none, nothing)
    weights = [exp(item.log_evidence - top) for item in items]
    unknown = exp(none - top) + exp(nothing - top)
    total = sum(weights) + unknown
    suspects = [unknown_suspect(unknown / total)]
    for effect in dict.fromkeys(item.effect for item in items):
        indices = [index for index, item in enumerate(items) if item.effect is effect]
        likeliest = items[max(indices, key=weights.__getitem__)]
        probability = sum(weights[index] for index in indices) / total
        kind = SENSOR if isinstance(effect, SensorEffect) else PROCESS
        suspects.append(Suspect(effect.name, likeliest.profile, probability, *likeliest[3:], kind))
    return sorted(suspects, key=lambda item: -item.probability)


def unknown_suspect(probability: float) -> Suspect:
    """Make the suspect `UNKNOWN`."""
    return Suspect(UNKNOWN, "", probability, nan, nan, nan, nan, UNKNOWN)
