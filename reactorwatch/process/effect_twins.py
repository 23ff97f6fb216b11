"""Twins: effects that do the same to a model, but for a factor of their sizes.

They are found by what they do: the balances, outputs, jumps and times of the model with either effect are compared at
points within its bounds, at sizes that correspond. So a name, or the code of an effect, does not matter.
"""

from collections.abc import Sequence
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.process.effect import Effect
from reactorwatch.process.generic_effects import Source, exchanges, generic_effects
from reactorwatch.process.model import ProcessModel

POINTS, SEED = 8, 1
"""Points at which models are compared, drawn from a seed."""

AGREEMENT = 1e-6
"""Largest difference between the changes of twins, as a fraction of the change."""


class EffectChanges:
    """Changes that an effect makes in a model.

    Args:
        model: the process model.
        effect: an effect on it.

    Attributes:
        effect: the effect as given.
        n_states: number of states that the effect adds.
    """

    def __init__(self, model: ProcessModel, effect: Effect) -> None:
        self.effect, self._own = effect, model
        size = ca.SX.sym("m")
        self._extended = extended = effect.apply(model, size)
        self.n_states = len(extended.states) - len(model.states)
        x, u, p = extended.arguments()
        clock = [extended.clock.now, extended.clock.middle]
        resets = ca.vertcat(*(extended.resets.get(state.name, state.symbol) for state in extended.states))
        noise = (ca.SX(0) if item.noise_variance is None else item.noise_variance for item in extended.outputs)
        outputs = (*(item.expression for item in extended.outputs), *noise)
        shown = ca.vertcat(*extended.rhs, *outputs, resets, extended.time_offset)
        self._function = ca.Function("changed", [x, u, p, *clock, size], [ca.densify(shown)])
        self._slope = ca.Function("slope", [x, u, p, *clock, size], [ca.densify(ca.jacobian(shown, size))])

    @cached_property
    def slopes(self) -> Array:
        """Derivatives of everything by the size at the neutral size, in all points."""
        return np.concatenate([self._evaluate(self._slope, number, self.effect.neutral) for number in range(POINTS)])

    def at(self, size: float) -> Array:
        """Changes of everything from the neutral size to this one, in all points; shape (points, values)."""
        return np.array(
            [
                self._evaluate(self._function, number, size)
                - self._evaluate(self._function, number, self.effect.neutral)
                for number in range(POINTS)
            ]
        )

    def _evaluate(self, function: ca.Function, number: int, size: float) -> Array:
        rng = np.random.default_rng([SEED, number])
        u = [rng.uniform(item.lower, item.upper) for item in self._own.inputs]
        x = [rng.uniform(item.lower, item.upper) for item in self._own.states]
        x += rng.uniform(0.0, max(u, default=1.0), self.n_states).tolist()  # states of the effect
        return np.array(function(x, u, self._extended.values(), 0.0, 0.0, size)).ravel()


def are_twins(one: EffectChanges, other: EffectChanges) -> bool:
    """Return true if two effects do the same to a model at sizes that correspond."""
    a, b = one.effect, other.effect
    if one.n_states != other.n_states or a.is_discontinuous != b.is_discontinuous:
        return False
    factor = 1.0
    if not one.n_states and not a.is_discontinuous:
        square = float(other.slopes @ other.slopes)
        factor = float(one.slopes @ other.slopes) / square if square > 0.0 else 0.0
    usual = a.upper if a.is_discontinuous else a.typical
    sizes = [
        size
        for size in (usual, -usual, 0.4 * usual)
        if a.lower <= size <= a.upper and b.lower <= factor * size <= b.upper and factor != 0.0
    ]
    return bool(sizes) and all(_agree(one.at(size), other.at(factor * size)) for size in sizes)


@lru_cache(maxsize=64)
def add_generic(model: ProcessModel, own: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """Effects of a process's own, then the generic ones of its model that are no twins of one of them."""
    changes = [EffectChanges(model, effect) for effect in own]
    return (*own, *(effect for effect in generic_effects(model) if not _has_twin(model, effect, changes)))


@lru_cache(maxsize=64)
def hidden_sources(model: ProcessModel, effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """Unmodelled sources of a model, and flows between two balances; what only these explain is unknown.

    A source that an effect of the catalogue adds already is left out.
    """
    names = {effect.name for effect in effects}
    sources = (item for item in generic_effects(model) if isinstance(item, Source) and item.name not in names)
    alone = tuple(item for item in sources if not any(_adds_rate(model, effect, item) for effect in effects))
    return (*alone, *exchanges(model))


def _adds_rate(model: ProcessModel, effect: Effect, source: Source) -> bool:
    """Return true if an effect is a twin of a source; most act elsewhere, too, which is known without numbers."""
    size = ca.SX.sym("m")
    extended = effect.apply(model, size)
    acts = [ca.depends_on(item, size) for item in extended.rhs]
    alone = [name == source.state for name in model.state_names]
    shown = any(ca.depends_on(item.expression, size) for item in extended.outputs)
    return acts == alone and not shown and are_twins(EffectChanges(model, effect), EffectChanges(model, source))


def _has_twin(model: ProcessModel, effect: Effect, others: Sequence[EffectChanges]) -> bool:
    own = EffectChanges(model, effect)
    return any(are_twins(other, own) for other in others)


def _agree(one: Array, other: Array) -> bool:
    finite = np.all(np.isfinite(one), axis=1) & np.all(np.isfinite(other), axis=1)
    if not np.any(finite):
        return False
    one, other = one[finite], other[finite]
    size = np.max(np.abs(one), axis=0)
    return bool(np.any(size)) and bool(np.all(np.abs(one - other) <= AGREEMENT * size + 1e-12))
