"""Screens beside that of single static effects: effects with internal states, and pairs of causes.

Screen for effects with internal states: lags, valve stiction, delays. They have no infinitesimal deviation, so each is
evaluated at a few typical magnitudes. Its signature is the reduction of the innovations by a magnitude. The internal
dynamics are fast beside the profiles, so the signature of a profile is taken for the signature times the profile.

Screen for pairs of causes: all pairs at once, linearised about a filter run. To first order the signature of two
deviations is the sum of theirs. So every cause gets a few columns: its signatures as a constant, as a piecewise-linear
curve, and as the sines that stand out. The gram matrix of all columns is computed once; the gain of any pair is then
the solution of a small linear system, so that the best of thousands of pairs can be found. (Forward selection sees one
cause at a time, and would start with a third cause that resembles both.)
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf, log
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.fault_filter import FilterEvaluation, huber_clip
from reactorwatch.diagnosis.fitting.hypothesis import Fit
from reactorwatch.diagnosis.fitting.profiles import (
    Constant,
    Decay,
    FittedProfile,
    PiecewiseLinear,
    Ramp,
    Signal,
    Sine,
    Step,
)
from reactorwatch.diagnosis.fitting.signatures import solve_bounded
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.screen import (
    DECAYS,
    EDGE_ROWS,
    KNOTS,
    Candidate,
    Part,
    Screen,
    all_finite,
    first_of_each,
)
from reactorwatch.kalman.error_dynamics import ErrorDynamics
from reactorwatch.process.effect import Effect
from reactorwatch.progress import track

Evaluate: TypeAlias = Callable[[Effect, Sequence[Signal]], Sequence[FilterEvaluation]]
"""Function from deviations of an effect to the filter results with them."""


class DynamicEffectsScreen:
    """Screens one run for effects with internal states.

    Args:
        effects: effects with internal states.
        run: the record.
    """

    def __init__(self, effects: Sequence[Effect], run: Run) -> None:
        self._effects, self._run = tuple(effects), run
        t = run.time_min
        self._constant, self._step, self._ramp, self._decay = Constant(t), Step(t), Ramp(t), Decay(t)
        self._free = PiecewiseLinear(t, KNOTS)

    def candidates(
        self, baseline: Fit, evaluate: Evaluate, of: Sequence[Effect] | None = None, least_score: float = 0.0
    ) -> list[Candidate]:
        """Best magnitude of each effect as a constant and, scaled from there, a step, a ramp, decays and a curve.

        Args:
            baseline: fit without any of these effects.
            evaluate: runs the filter of the same hypothesis plus deviations of one effect.
            of: effects to screen; None: all.
            least_score: predicted gains below this, in BIC, are not confirmed by a filter run.
        """
        result = []
        for effect in track("screening dynamic cause", self._effects if of is None else of):
            starts = effect.start_values or (effect.typical,)
            results = evaluate(effect, [self._constant.signal(np.array([start])) for start in starts])
            gains = [2.0 * (baseline.loss - item.loss) for item in results]
            best = int(np.argmax(gains))
            if gains[best] > 0.0:
                result.append(Candidate(effect, self._constant, np.array([starts[best]]), gains[best]))
            w = huber_clip(baseline.w)
            reductions = [(w - huber_clip(item.w)) / start for start, item in zip(starts, results, strict=True)]
            scaled = [self.scale_signature(effect, w, g) for g in reductions]
            confirmations = self._confirmations(baseline, evaluate, scaled, least_score)
            for candidates, confirmed in zip(scaled, confirmations, strict=True):
                # A discontinuous effect does not scale: a fit has to scan its size, and can scan only one.
                result += [
                    replace(item, gain=confirmed * item.gain)
                    for item in candidates
                    if confirmed > 0.0 and (not effect.is_discontinuous or item.profile.name in ("constant", "step"))
                ]
        return result

    def _confirmations(
        self, baseline: Fit, evaluate: Evaluate, scaled: Sequence[Sequence[Candidate]], least_score: float
    ) -> list[float]:
        """Fraction of the predicted gain that a filter run at that constant magnitude confirms, at most 1.

        Small predictions and discontinuous effects are taken without a run.
        """
        confirmed, to_confirm = [1.0] * len(scaled), []
        for number, candidates in enumerate(scaled):
            constant = candidates[0]
            if (
                constant.effect.is_discontinuous
                or max(item.score(self._run.values) for item in candidates) <= least_score
            ):
                continue
            if constant.gain > 0.0:
                to_confirm.append(number)
            elif constant.gain < 0.0:
                confirmed[number] = 0.0
        if to_confirm:
            signals = [self._constant.signal(scaled[number][0].parameters) for number in to_confirm]
            for number, item in zip(to_confirm, evaluate(scaled[0][0].effect, signals), strict=True):
                confirmed[number] = min(2.0 * (baseline.loss - item.loss) / scaled[number][0].gain, 1.0)
        return confirmed

    def scale_signature(self, effect: Effect, w: Array, g: Array) -> list[Candidate]:
        """Candidates from the signature of a unit magnitude in every row.

        Args:
            effect: the effect.
            w: normalised innovations to explain, shape (rows, n_y).
            g: the signature, shape (rows, n_y).
        """
        a, b = np.sum(w * g, axis=1), np.sum(g * g, axis=1)
        t = self._run.time_min
        candidates = [_candidate(effect, self._constant, a.sum(), b.sum(), ())]
        later_a, later_b = _sums_to_end(a), _sums_to_end(b)
        moments = [_sums_to_end(item * t**power) for item in (a, b) for power in (0, 1, 2)]
        span = np.maximum(t[-1] - t, self._ramp.period_min)
        grown_a = (moments[1] - t * moments[0]) / span
        grown_b = np.maximum(moments[5] - 2 * t * moments[4] + t**2 * moments[3], 0.0) / span**2
        onsets: list[tuple[FittedProfile, Array, Array, tuple[float, ...]]]
        onsets = [(self._step, later_a, later_b, ()), (self._ramp, grown_a, grown_b, ())]
        for share in DECAYS:
            constant = share * self._run.span_min
            remaining = np.exp((t[-1] - t) / constant)  # backwards from the end
            short_a, short_b, shorter_b = (
                _sums_to_end(item * w) / w for item, w in ((a, remaining), (b, remaining), (b, remaining**2))
            )
            grown_b = np.maximum(later_b - 2.0 * short_b + shorter_b, 0.0)
            onsets.append((self._decay, later_a - short_a, grown_b, (constant,)))
        for profile, of_a, of_b, shape in onsets:
            index = _best(of_a, of_b, effect)
            candidates.append(_candidate(effect, profile, of_a[index], of_b[index], (t[index], *shape)))
        hats = self._free.basis_functions(np.empty(0))[0]
        A, B = hats.T @ a, hats.T @ (hats * b[:, None])
        by = np.clip(np.asarray(np.linalg.lstsq(B, A, rcond=1e-9)[0]), effect.lower, effect.upper)
        candidates.append(Candidate(effect, self._free, by, float(by @ (2.0 * A - B @ by))))
        return candidates


def _sums_to_end(values: Array) -> Array:
    """Sums from each row to the last."""
    return np.asarray(np.cumsum(values[::-1])[::-1])


def _candidate(effect: Effect, profile: FittedProfile, a: float, b: float, shape: tuple[float, ...]) -> Candidate:
    """Candidate at the nearest possible magnitude, with the gain there, because a filter run is compared with it."""
    size = float(np.clip(a / max(b, 1e-300), effect.lower, effect.upper))
    return Candidate(effect, profile, np.array([size, *shape]), size * (2.0 * float(a) - size * float(b)))


def _best(a: Array, b: Array, effect: Effect) -> int:
    size = np.clip(a / np.maximum(b, 1e-300), effect.lower, effect.upper)
    gain = size * (2.0 * a - size * b)
    return EDGE_ROWS + int(np.argmax(gain[EDGE_ROWS:-EDGE_ROWS]))


REMOVED_CAUSES, SINES_SHARE = 2, 0.3
"""Number of causes that are removed in turn to see sines beneath them, and minimum gain of a sine as a fraction of the
best."""

_RIDGE = 1e-9
_MOST_SIZES = 3.0


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
    ) -> list[tuple[Part, Part]]:
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

    def _rank(self, blocks: Sequence[_Block], w: Array, count: int) -> list[tuple[Part, Part]]:
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
        for _, i, j, parameters in sorted(best.values(), key=lambda item: -item[0])[:count]:
            middle = places[i].size
            result.append((_part(blocks[i], parameters[:middle]), _part(blocks[j], parameters[middle:])))
        return result

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
