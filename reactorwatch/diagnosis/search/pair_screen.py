"""Screen for pairs of causes: all pairs at once, linearised about a filter run.

To first order the signature of two deviations is the sum of theirs. So every cause gets a few columns: its signatures
as a constant, as a piecewise-linear curve, and as the sines that stand out. The gram matrix of all columns is computed
once; the gain of any pair is then the solution of a small linear system, so that the best of thousands of pairs can be
found. (Forward selection sees one cause at a time, and would start with a third cause that resembles both.)

Effects with internal states are evaluated at a few magnitudes, as in `dynamic_effects_screen`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf, log

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.profiles import Constant, FittedProfile, PiecewiseLinear, Sine
from reactorwatch.diagnosis.fitting.signatures import solve_bounded
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.screen import KNOTS, Part, Screen, all_finite, first_of_each
from reactorwatch.kalman.error_dynamics import ErrorDynamics
from reactorwatch.process.effect import Effect

REMOVED_CAUSES, SINES_SHARE = 2, 0.3
"""Number of causes that are removed in turn to see sines beneath them, and minimum gain of a sine as a fraction of the
best."""

_RIDGE = 1e-9
_MOST_SIZES = 3.0


@dataclass(frozen=True, eq=False)
class CandidatePair:
    """Two causes with profiles that may explain the innovations.

    Attributes:
        parts: the causes with initial parameters.
        score: predicted gain in BIC.
    """

    parts: tuple[Part, ...]
    score: float

    @property
    def causes(self) -> frozenset[str]:
        """Names of the causes."""
        return frozenset(part.effect.name for part in self.parts)


@dataclass(frozen=True, eq=False)
class _Block:
    """Columns of one cause with a profile at nonlinear parameters, shape (values, n_linear).

    An effect with internal states has a size: its magnitude at a coefficient of 1.
    """

    effect: Effect
    profile: FittedProfile
    shape: Array
    size: float | None
    columns: Array


class PairScreen:
    """Screens a run for pairs.

    Args:
        screen: screen for single causes of the run.
        run: the record.
    """

    def __init__(self, screen: Screen, run: Run) -> None:
        self._screen, self._run = screen, run
        t = run.time_min
        self._constant, self._free, self._sine = Constant(t), PiecewiseLinear(t, KNOTS), Sine(t)

    def candidates(
        self, dynamics: ErrorDynamics, dynamic: Sequence["DynamicSignature"], count: int
    ) -> list[CandidatePair]:
        """Best candidate of each pair of causes, the most promising first.

        Args:
            dynamics: error equations of all static effects, with the innovations to explain.
            dynamic: signatures of the effects with internal states.
            count: number of candidates.
        """
        if not all_finite(dynamics):
            return []
        w = dynamics.w.ravel()
        blocks = [*self._static_blocks(dynamics), *self._dynamic_blocks(dynamic, w)]
        blocks += self._sine_blocks(dynamics, blocks, w)
        if not blocks:
            return []
        return self._rank(blocks, w, count)

    def _static_blocks(self, dynamics: ErrorDynamics) -> Iterator[_Block]:
        """Every static effect as a constant and as a curve."""
        interval_mean, sample_value = self._free.basis_signals(np.empty(0))[:2]
        for cause, effect in enumerate(self._screen.static_effects):
            g = signatures.forward_signatures(dynamics, cause, interval_mean[1:-1], sample_value[2:]).reshape(-1, KNOTS)
            yield from self._blocks_of(effect, None, g)

    def _dynamic_blocks(self, dynamic: Sequence["DynamicSignature"], w: Array) -> Iterator[_Block]:
        """Every effect with internal states as a constant at each magnitude, and as a curve at the best of them."""
        hats = self._free.basis_functions(np.empty(0))[0][2:]
        for effect in dict.fromkeys(item.effect for item in dynamic):
            evaluated = []
            for item in dynamic:
                g = (item.g[2:, :, None] * hats[:, None, :]).reshape(-1, KNOTS)
                if item.effect is effect and np.all(np.isfinite(g)):
                    evaluated.append((_gain(g, w)[0], list(self._blocks_of(effect, item.size, g))))
            best = max((gain for gain, _ in evaluated), default=0.0)
            for gain, (constant, curve) in evaluated:
                yield constant
                if gain == best:
                    yield curve

    def _blocks_of(self, effect: Effect, size: float | None, g: Array) -> Iterator[_Block]:
        if np.all(np.isfinite(g)):
            yield _Block(effect, self._constant, np.empty(0), size, g.sum(axis=1, keepdims=True))
            yield _Block(effect, self._free, np.empty(0), size, g)

    def _sine_blocks(self, dynamics: ErrorDynamics, blocks: Sequence[_Block], w: Array) -> Iterator[_Block]:
        """Sines that stand out, also once the best other cause is removed."""
        result: dict[tuple[str, float], _Block] = {}
        curves = [block for block in blocks if block.profile is self._free]
        by_gain = sorted(curves, key=lambda block: -_gain(block.columns, w)[0])
        strongest = first_of_each(by_gain, lambda block: block.effect.name)[:REMOVED_CAUSES]
        for residual in [w, *(w - block.columns @ _gain(block.columns, w)[1] for block in strongest)]:
            about = replace(dynamics, w=residual.reshape(dynamics.w.shape))
            candidates = self._screen.sine_candidates(about, self._screen.static_effects)
            candidates = [item for item in candidates if np.isfinite(item.gain)]
            least = max([0.0, *(SINES_SHARE * item.score(self._run.values) for item in candidates)])
            for candidate in candidates:
                period = candidate.parameters[2:]
                key = (candidate.effect.name, round(log(float(period[0])), 2))
                if candidate.score(self._run.values) > least and key not in result:
                    interval_mean, sample_value = self._sine.basis_signals(period)[:2]
                    cause = self._screen.static_effects.index(candidate.effect)
                    g = signatures.forward_signatures(about, cause, interval_mean[1:-1], sample_value[2:])
                    result[key] = _Block(candidate.effect, self._sine, period, None, g.reshape(-1, 2))
        yield from result.values()

    def _rank(self, blocks: Sequence[_Block], w: Array, count: int) -> list[CandidatePair]:
        """Best candidate of each pair of causes.

        Bounds only reduce a gain, so the bounded gain is computed for the most promising pairs alone, until the others
        predict less.
        """
        columns = np.concatenate([block.columns for block in blocks], axis=1)
        gram, by = signatures.gram_of_columns(columns), columns.T @ w
        ends = np.cumsum([block.columns.shape[1] for block in blocks])
        places = [np.arange(end - block.columns.shape[1], end) for end, block in zip(ends, blocks, strict=True)]
        price = log(self._run.values)
        best: dict[frozenset[str], tuple[float, int, int, Array]] = {}
        for promised, i, j in self._bound_gains(blocks, places, gram, by):
            if len(best) >= count and sorted((item[0] for item in best.values()), reverse=True)[count - 1] > promised:
                break
            first, second = blocks[i], blocks[j]
            both = np.concatenate([places[i], places[j]])
            lowest, highest = (np.concatenate(ends) for ends in zip(_range(first), _range(second), strict=True))
            gain, parameters = solve_bounded(gram[np.ix_(both, both)], by[both], lowest, highest)
            score = gain - price * (first.profile.n_parameters + second.profile.n_parameters)
            key = frozenset((first.effect.name, second.effect.name))
            if score > best.get(key, (-inf,))[0]:
                best[key] = (score, i, j, parameters)
        result = []
        for score, i, j, parameters in best.values():
            middle = places[i].size
            parts = (_part(blocks[i], parameters[:middle]), _part(blocks[j], parameters[middle:]))
            result.append(CandidatePair(parts, score))
        return sorted(result, key=lambda item: -item.score)[:count]

    def _bound_gains(
        self, blocks: Sequence[_Block], places: Sequence[NDArray[np.int64]], gram: Array, by: Array
    ) -> list[tuple[float, int, int]]:
        """Gain in BIC of any two blocks without bounds, the largest first."""
        of_size: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for i, first in enumerate(blocks):
            for j in range(i + 1, len(blocks)):
                if can_be_together(first.effect, blocks[j].effect):
                    of_size.setdefault((places[i].size, places[j].size), []).append((i, j))
        price, scale = log(self._run.values), np.sqrt(np.maximum(np.diag(gram), 1e-300))
        scaled, scaled_by = gram / np.outer(scale, scale), by / scale
        scaled[np.diag_indices_from(scaled)] += _RIDGE
        result = []
        for pairs in of_size.values():
            both = np.array([np.concatenate([places[i], places[j]]) for i, j in pairs])
            a = scaled_by[both]
            gains = np.einsum(
                "ni,ni->n", a, np.linalg.solve(scaled[both[:, :, None], both[:, None, :]], a[..., None])[..., 0]
            )
            for gain, (i, j) in zip(gains.tolist(), pairs, strict=True):
                result.append((gain - price * (blocks[i].profile.n_parameters + blocks[j].profile.n_parameters), i, j))
        return sorted(result, reverse=True)


def can_be_together(one: Effect, other: Effect) -> bool:
    """Return true if two effects make a pair: a filter delays one output, and an unmodelled source names nothing."""
    if one is other or one.is_source != other.is_source:
        return False
    return one.delays_output is None or other.delays_output is None


@dataclass(frozen=True, eq=False)
class DynamicSignature:
    """Signature of an effect with internal states at a constant magnitude.

    Attributes:
        effect: the effect.
        size: magnitude of the effect.
        g: reduction of the innovations, shape (rows, n_y).
    """

    effect: Effect
    size: float
    g: Array


def _part(block: _Block, by: Array) -> Part:
    parameters = np.concatenate([by * (1.0 if block.size is None else block.size), block.shape])
    return Part(block.effect, block.profile, block.profile.clip(parameters, block.effect.lower, block.effect.upper))


def _range(block: _Block) -> tuple[Array, Array]:
    """Bounds of the coefficients. Internal states are not linear far beyond a magnitude that was evaluated."""
    effect, count = block.effect, block.columns.shape[1]
    lower, upper = (effect.lower, effect.upper) if not isinstance(block.profile, Sine) else (-inf, inf)
    if block.size is not None:
        lower, upper = lower / block.size, min(upper / block.size, _MOST_SIZES)
    return np.full(count, lower), np.full(count, upper)


def _gain(columns: Array, w: Array) -> tuple[float, Array]:
    unbounded = np.full(columns.shape[1], inf)
    return solve_bounded(columns.T @ columns, columns.T @ w, -unbounded, unbounded)
