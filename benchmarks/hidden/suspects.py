"""Suspects of the monitor on hidden causes: their probabilities at the last look, beside the truth."""

from dataclasses import dataclass, replace

import numpy as np

import reactorwatch as rw
from benchmarks.hidden.classes import NEARLY, find_class
from monitor_node.causes.isolation import causes_of
from reactorwatch.description.read import find_process
from tests.hidden_effect.catalogue import named
from tests.hidden_effect.draw import CannotHideError, Hidden, draw

SPAN_MIN, TRAINING_MIN, LATEST = 300.0, 60.0, 0.65
"""Length of a record and of its training; latest onset as a share of the span."""

SET = 0.9
TRIES = 200


@dataclass(frozen=True)
class SuspectsJudged:
    """Suspects of one alarm."""

    truth: str  # name of the hidden cause
    nearly: bool  # whether the plant is not quite the model
    first_probability: float  # probability of the first suspect
    first: bool  # whether it is the hidden cause
    in_set: bool  # whether the hidden cause is in the smallest set with 90 %


def judge_suspects(job: tuple[int, bool, int]) -> SuspectsJudged | None:
    """Draw a record of a number, watch it, and judge the last suspects; None if no alarm has any."""
    number, nearly, first_seed = job
    hidden = _draw(number, nearly, first_seed)
    found = rw.backtest(hidden.record, "cstr", training_min=TRAINING_MIN)
    suspects = next((alarm.suspect for alarm in reversed(found.alarms) if alarm.suspect), None)
    if suspects is None:
        return None
    (truth,) = hidden.causes
    ordered = sorted(((item.probability, item.cause) for item in suspects), reverse=True)
    before = np.cumsum([0.0, *(probability for probability, _ in ordered[:-1])])
    in_set = {cause for (_, cause), total in zip(ordered, before.tolist(), strict=True) if total < SET}
    probability, cause = ordered[0]
    return SuspectsJudged(truth, nearly, probability, cause == truth, truth in in_set)


def _draw(number: int, nearly: bool, first_seed: int) -> Hidden:
    """A record with a step of a cause that the monitor compares, after the training."""
    reactor = find_process().model
    assert reactor is not None
    traced = {effect.name for effect in causes_of(reactor)}
    effects = [effect for effect in named() if effect.name in traced and "step" in effect.courses]
    effect = effects[number % len(effects)]
    circumstances = replace(find_class(NEARLY if nearly else "medium").circumstances(number), span_min=SPAN_MIN)
    for turn in range(TRIES):
        try:
            hidden = draw(first_seed + 1000 * number + turn, (effect,), circumstances, ("step",))
        except CannotHideError:
            continue
        if TRAINING_MIN + 10.0 < hidden.courses[0].onset_min < LATEST * SPAN_MIN:
            return hidden
    raise CannotHideError(f"seed {first_seed}: no step of {effect.name} after the training")
