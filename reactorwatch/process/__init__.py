"""Process models, their simulation, their steady states, and effects on them."""

from collections.abc import Mapping
from typing import cast

from reactorwatch.process.effect import Effect
from reactorwatch.process.generic import generic_effects
from reactorwatch.process.library import cascaded_tanks, cstr, cstr_operation, three_tanks
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.operation import Operation

MODELS = (cstr.cstr, cascaded_tanks.tanks, three_tanks.three_tanks)
"""The catalogue of process models: functions that build them."""

DEFAULT_PROCESS = "cstr"
"""Process where none is named."""

EFFECTS_OF: Mapping[str, tuple[Effect, ...]] = {
    "cstr": cstr.EFFECTS,
    "tanks": cascaded_tanks.EFFECTS,
    "three_tanks": three_tanks.EFFECTS,
}
"""The catalogue of effects, by name of a model."""

OPERATIONS: Mapping[str, Operation] = {
    "cstr": cstr_operation.OPERATION,
    "tanks": cascaded_tanks.OPERATION,
    "three_tanks": three_tanks.OPERATION,
}
"""Operation in a simulation, by name of a model."""

LOCATION_PHRASES: Mapping[str, str] = cstr.LOCATIONS | cascaded_tanks.LOCATIONS
"""Phrases of locations whose name is not enough, such as `on the side of the coolant`."""


def own_effects(model: ProcessModel) -> tuple[Effect, ...]:
    """Effects of a model's own: those that it has, else those of the catalogue under its name."""
    return EFFECTS_OF.get(model.name, ()) if model.effects is None else cast(tuple[Effect, ...], model.effects)


def effects_of(model: ProcessModel) -> tuple[Effect, ...]:
    """Effects of a model: its own, or the generic ones if it has none."""
    return own_effects(model) or generic_effects(model)


def named_effects(model: ProcessModel) -> tuple[Effect, ...]:
    """Effects that a text may name: those of the model's own first, then the generic ones."""
    own = own_effects(model)
    names = {effect.name for effect in own}
    return (*own, *(effect for effect in generic_effects(model) if effect.name not in names))
