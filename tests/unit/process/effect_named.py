"""An effect of the reactor's catalogue by its name, and a model with it."""

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import CONSTANT, STEP


def effect_of(name: str) -> Effect:
    return next(effect for effect in EFFECTS if effect.name == name)


def extend_cstr(
    cause: str, size: float, base: ProcessModel | None = None, onset_min: float | None = None
) -> ProcessModel:
    """The reactor, or another model, with an effect: always, or from a time on."""
    profile = CONSTANT if onset_min is None else STEP
    onset = {} if onset_min is None else {f"{cause}.onset": onset_min}
    return effect_of(cause).extend(base or cstr(), profile).with_values({f"{cause}.size": size, **onset})
