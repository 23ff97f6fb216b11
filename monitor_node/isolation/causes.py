"""Causes to which an alarm is traced: effects of the process's own.

An effect that adds a state, or is discontinuous, has no infinitesimal deviation, and is left to a diagnosis of the
record.
"""

from functools import lru_cache

from reactorwatch.kalman.ekf_step import MODEL_CACHE_SIZE
from reactorwatch.process import own_effects
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def causes_of(model: ProcessModel) -> tuple[Effect, ...]:
    """Causes to which alarms of a plant with these equations are traced; empty if it has no effects of its own."""
    traced = (effect for effect in own_effects(model) if effect.is_traced and not effect.is_discontinuous)
    return tuple(effect for effect in traced if effect.extend(model).state_names == model.state_names)
