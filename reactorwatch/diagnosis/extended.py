"""Extended model: the model with the diagnosed causes, in the format of its file."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from reactorwatch.diagnosis.result import Cause
from reactorwatch.process.effect import Effect
from reactorwatch.process.extended_model import are_named, extend, extended_model_of, is_complete
from reactorwatch.process.fault import FaultSpecification
from reactorwatch.process.law import ExtendedLaw
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import FREE_NAME, PROFILES, free_profile

WITHIN = 1.0 - 1e-12
"""Factor for a knot at an effect's bounds: it is stored as a fraction of the size, and their product is rounded."""


def extended_model(
    model: ProcessModel,
    effects: Sequence[Effect],
    causes: Sequence[Cause],
    zero_ns: int = 0,
    law: ExtendedLaw | None = None,
) -> dict[str, Any]:
    """Extended model with the causes, as in its file (`reactorwatch.process.extended_model`).

    Args:
        model: process model of the simulation; the effects that it has already stay.
        effects: the catalogue.
        causes: diagnosed causes.
        zero_ns: time from which the record's minutes count; 0: not known.
        law: law of an unknown; None: none.
    """
    named = {effect.name: effect for effect in effects}
    before = extended_model_of(model, effects, zero_ns=zero_ns)
    result = [_specification(named[cause.cause], cause) for cause in causes]
    new_laws = () if law is None else (law,)
    found = replace(before, effects=(*before.effects, *result), laws=(*before.laws, *new_laws))
    if not (is_complete(before, model) and are_named(found)):
        found = replace(found, equations=extend(model, result, new_laws))
    return found.to_object()


def _specification(effect: Effect, cause: Cause) -> FaultSpecification:
    values = {name: estimate.value for name, estimate in cause.parameters.items()}
    size = values["size"] = min(max(values["size"], effect.lower), effect.upper)
    if cause.profile != FREE_NAME:
        return FaultSpecification(effect, next(item for item in PROFILES if item.name == cause.profile), values)
    shares = {name: share for name, share in values.items() if name.startswith("value_")}
    for name, share in shares.items():
        values[name] = share if effect.lower <= size * share <= effect.upper else WITHIN * share
    return FaultSpecification(effect, free_profile(len(shares)), values)
