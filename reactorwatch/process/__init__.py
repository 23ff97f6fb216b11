"""The process description, said once: models, their simulation, their steady states, and deviations from them."""

from collections.abc import Mapping

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cascaded_tanks.effects import TANK_EFFECTS
from reactorwatch.process.library.cascaded_tanks.model import tanks
from reactorwatch.process.library.cstr.effects import EFFECTS
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.model import ProcessModel

MODELS = (cstr, tanks)
"""The process models there are: functions that build them."""

EFFECTS_OF: Mapping[str, tuple[Effect, ...]] = {"cstr": EFFECTS, "tanks": TANK_EFFECTS}
"""By the name of a model, the catalogue of what may be different in it."""


def effects_of(model: ProcessModel) -> tuple[Effect, ...]:
    """The catalogue of a model's effects; empty for a model that has none."""
    return EFFECTS_OF.get(model.name, ())
