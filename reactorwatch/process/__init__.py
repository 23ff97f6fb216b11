"""Process models, their simulation, their steady states, and effects on them."""

from collections.abc import Mapping

from reactorwatch.process.effect import Effect
from reactorwatch.process.generic_effects import generic_effects
from reactorwatch.process.library.cascaded_tanks.effects import TANK_EFFECTS
from reactorwatch.process.library.cascaded_tanks.model import tanks
from reactorwatch.process.library.cstr.effects import EFFECTS
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.library.three_tanks.effects import THREE_TANKS_EFFECTS
from reactorwatch.process.library.three_tanks.model import three_tanks
from reactorwatch.process.model import ProcessModel

MODELS = (cstr, tanks, three_tanks)
"""The catalogue of process models: functions that build them."""

EFFECTS_OF: Mapping[str, tuple[Effect, ...]] = {
    "cstr": EFFECTS,
    "tanks": TANK_EFFECTS,
    "three_tanks": THREE_TANKS_EFFECTS,
}
"""The catalogue of effects, by name of a model."""


def effects_of(model: ProcessModel) -> tuple[Effect, ...]:
    """Effects of a model: its own catalogue, or the generic ones if it has none."""
    return EFFECTS_OF.get(model.name) or generic_effects(model)


def named_effects(model: ProcessModel) -> tuple[Effect, ...]:
    """Effects that a text may name: those of the model's own catalogue first, then the generic ones."""
    own = EFFECTS_OF.get(model.name, ())
    names = {effect.name for effect in own}
    return (*own, *(effect for effect in generic_effects(model) if effect.name not in names))
