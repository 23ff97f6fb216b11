"""Effects with other values of their own constants, so that a screen sees what those values do.

A screen is linear about the nominal constants, and a side reaction with twice the heat does something else. So an
effect is also screened at the start values of its constants, and a candidate takes them along.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel


class ConstantVariant(Effect):
    """An effect with fixed values of its own constants.

    Args:
        effect: the effect.
        values: values of its constants.

    Attributes:
        effect: the effect as given.
        values: the values as given.
    """

    def __init__(self, effect: Effect, values: Sequence[float]) -> None:
        self.effect, self.values = effect, tuple(values)
        facts = {"name": f"{effect.name}@{','.join(f'{value:g}' for value in values)}"}
        facts |= {name: getattr(effect, name) for name in ("label", "location", "unit", "lower", "upper", "typical")}
        for name, value in facts.items():
            setattr(self, name, value)

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        prefix, extended = self.effect.prefix(model), self.effect.apply(model, size)
        names = [f"{prefix}.{item.name}" for item in self.effect.constants]
        for name, value in zip(names, self.values, strict=True):
            extended = extended.substitute(extended.parameter(name).symbol, ca.SX(value))
        return replace(extended, parameters=tuple(item for item in extended.parameters if item.name not in names))


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def variants_of(effects: tuple[Effect, ...]) -> tuple[ConstantVariant, ...]:
    """Variants of effects, at every combination of the start values of their constants; made once."""
    return tuple(
        ConstantVariant(effect, values)
        for effect in effects
        if effect.constants
        for values in product(*(item.start_values for item in effect.constants))
    )
