"""Which two causes come into question together: all pairs at once, linearised about a run of the filter.

What two deviations do together is, to first order, the sum of what each does. So every cause gets a few columns: what
it does to the innovations as a constant, as a curve through some knots, and as the sines that stand out. The products
of all columns with each other and with what there is to explain are taken once; the gain of any pair then is that of a
small system of linear equations, and of thousands of pairs the best can be had (forward selection, which sees one cause
at a time, would begin with a third cause that looks like both).

Effects with memory are tried at a few sizes, as in `dynamic_effects_screen`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import inf, log

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.bounded_least_squares import within
from reactorwatch.diagnosis.fitting.profiles import Constant, Course, Free, Sine
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.screen import KNOTS, Screen, usable
from reactorwatch.kalman.error_dynamics import ErrorDynamics
from reactorwatch.process.effect import Effect

TAKEN_AWAY, SINES_SHARE = 2, 0.3
"""How many causes are taken away in turn to see sines below, and what share of the best one's gain a sine must have."""

BLOCK, NEGLIGIBLE = 512, 1e-9
"""Values whose products are summed at once, and the share of a column's largest that is taken for nothing."""

_RIDGE = 1e-9
_MOST_SIZES = 3.0


@dataclass(frozen=True, eq=False)
class PairLead:
    """Two causes, each with a course, that may explain what is left.

    Attributes:
        parts: of each the cause, its course, and where a fit may begin.
        score: the gain in BIC that the linear model promises.
    """

    parts: tuple[tuple[Effect, Course, Array], ...]
    score: float

    @property
    def causes(self) -> frozenset[str]:
        """Their names."""
        return frozenset(effect.name for effect, _, _ in self.parts)


@dataclass(frozen=True, eq=False)
class Block:
    """One cause with one kind of course.

    Attributes:
        effect: the cause.
        course: its course.
        shape: the course's numbers.
        size: that a coefficient of 1 stands for, of an effect with memory; None: 1.
        columns: what each function of the course does to the innovations, shape (values, coefficients).
    """

    effect: Effect
    course: Course
    shape: Array
    size: float | None
    columns: Array


class PairScreen:
    """Looks for pairs in a run.

    Args:
        screen: of the run.
        run: the record.
    """

    def __init__(self, screen: Screen, run: Run) -> None:
        self._screen, self._run = screen, run
        t = run.time_min
        self._constant, self._free, self._sine = Constant(t), Free(t, KNOTS), Sine(t)

    def leads(self, ways: ErrorDynamics, memory: Sequence["Remembered"], count: int) -> list[PairLead]:
        """The best of each two causes, the most promising first.

        Args:
            ways: of all direct effects, with what there is to explain.
            memory: what effects with memory do at some sizes.
            count: how many.
        """
        if not usable(ways):
            return []
        w = ways.w.ravel()
        blocks = [*self._slow(ways), *self._remembered(memory, w)]
        blocks += self._swinging(ways, blocks, w)
        if not blocks:
            return []
        return self._ranked(blocks, w, count)

    def _slow(self, ways: ErrorDynamics) -> Iterator[Block]:
        """Every direct effect as a constant and as a curve."""
        over_row, at_row = self._free.basis(np.empty(0))
        for cause, effect in enumerate(self._screen.direct):
            g = signatures.shown(ways, cause, over_row[1:-1], at_row[2:]).reshape(-1, KNOTS)
            yield from self._both(effect, None, g)

    def _remembered(self, memory: Sequence["Remembered"], w: Array) -> Iterator[Block]:
        """Every effect with memory as a constant about each of its sizes, and as a curve about the best of these."""
        hats = self._free.functions(np.empty(0))[0][2:]
        for effect in dict.fromkeys(item.effect for item in memory):
            tried = []
            for item in memory:
                g = (item.g[2:, :, None] * hats[:, None, :]).reshape(-1, KNOTS)
                if item.effect is effect and np.all(np.isfinite(g)):
                    tried.append((_gain(g, w)[0], list(self._both(effect, item.size, g))))
            best = max((gain for gain, _ in tried), default=0.0)
            for gain, (constant, curve) in tried:
                yield constant
                if gain == best:
                    yield curve

    def _both(self, effect: Effect, size: float | None, g: Array) -> Iterator[Block]:
        if np.all(np.isfinite(g)):
            yield Block(effect, self._constant, np.empty(0), size, g.sum(axis=1, keepdims=True))
            yield Block(effect, self._free, np.empty(0), size, g)

    def _swinging(self, ways: ErrorDynamics, blocks: Sequence[Block], w: Array) -> Iterator[Block]:
        """The sines that stand out, and those that do once the best other cause is taken away."""
        found: dict[tuple[str, float], Block] = {}
        curves = [block for block in blocks if block.course is self._free]
        by_gain = sorted(curves, key=lambda block: -_gain(block.columns, w)[0])
        strongest = _of_different_causes(by_gain)[:TAKEN_AWAY]
        for rest in [w, *(w - block.columns @ _gain(block.columns, w)[1] for block in strongest)]:
            about = ErrorDynamics(ways.F, ways.G, ways.H, ways.D, ways.K, ways.whitening, rest.reshape(ways.w.shape))
            leads = [item for item in self._screen.swinging(about, self._screen.direct) if np.isfinite(item.gain)]
            least = max([0.0, *(SINES_SHARE * item.score(self._run.values) for item in leads)])
            for lead in leads:
                period = lead.theta[2:]
                key = (lead.effect.name, round(log(float(period[0])), 2))
                if lead.score(self._run.values) > least and key not in found:
                    over_row, at_row = self._sine.basis(period)
                    cause = self._screen.direct.index(lead.effect)
                    g = signatures.shown(about, cause, over_row[1:-1], at_row[2:])
                    found[key] = Block(lead.effect, self._sine, period, None, g.reshape(-1, 2))
        yield from found.values()

    def _ranked(self, blocks: Sequence[Block], w: Array, count: int) -> list[PairLead]:
        """The best of as many sets of two causes.

        What is possible gains at most as much as what is not, so the possible gain is taken of the most promising
        alone, until those that are left promise less.
        """
        columns = np.concatenate([block.columns for block in blocks], axis=1)
        gram, by = _products(columns), columns.T @ w
        ends = np.cumsum([block.columns.shape[1] for block in blocks])
        places = [np.arange(end - block.columns.shape[1], end) for end, block in zip(ends, blocks, strict=True)]
        price = log(self._run.values)
        best: dict[frozenset[str], tuple[float, int, int, Array]] = {}
        for promised, i, j in self._promised(blocks, places, gram, by):
            if len(best) >= count and sorted((item[0] for item in best.values()), reverse=True)[count - 1] > promised:
                break
            first, second = blocks[i], blocks[j]
            both = np.concatenate([places[i], places[j]])
            lowest, highest = (np.concatenate(ends) for ends in zip(_range(first), _range(second), strict=True))
            gain, theta = within(gram[np.ix_(both, both)], by[both], lowest, highest)
            score = gain - price * (first.course.freedom + second.course.freedom)
            key = frozenset((first.effect.name, second.effect.name))
            if score > best.get(key, (-inf,))[0]:
                best[key] = (score, i, j, theta)
        found = []
        for score, i, j, theta in best.values():
            middle = places[i].size
            parts = (_part(blocks[i], theta[:middle]), _part(blocks[j], theta[middle:]))
            found.append(PairLead(parts, score))
        return sorted(found, key=lambda item: -item.score)[:count]

    def _promised(
        self, blocks: Sequence[Block], places: Sequence[NDArray[np.int64]], gram: Array, by: Array
    ) -> list[tuple[float, int, int]]:
        """The gain in BIC of any two blocks if any sizes were possible, the largest first."""
        of_size: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for i, first in enumerate(blocks):
            for j in range(i + 1, len(blocks)):
                if first.effect is not blocks[j].effect:
                    of_size.setdefault((places[i].size, places[j].size), []).append((i, j))
        price, scale = log(self._run.values), np.sqrt(np.maximum(np.diag(gram), 1e-300))
        scaled, scaled_by = gram / np.outer(scale, scale), by / scale
        scaled[np.diag_indices_from(scaled)] += _RIDGE
        found = []
        for pairs in of_size.values():
            both = np.array([np.concatenate([places[i], places[j]]) for i, j in pairs])
            a = scaled_by[both]
            gains = np.einsum(
                "ni,ni->n", a, np.linalg.solve(scaled[both[:, :, None], both[:, None, :]], a[..., None])[..., 0]
            )
            for gain, (i, j) in zip(gains.tolist(), pairs, strict=True):
                found.append((gain - price * (blocks[i].course.freedom + blocks[j].course.freedom), i, j))
        return sorted(found, reverse=True)


@dataclass(frozen=True, eq=False)
class Remembered:
    """What an effect with memory does at a constant size.

    Attributes:
        effect: it.
        size: of it.
        g: what the innovations lose, shape (rows, n_y).
    """

    effect: Effect
    size: float
    g: Array


def _part(block: Block, by: Array) -> tuple[Effect, Course, Array]:
    theta = np.concatenate([by * (1.0 if block.size is None else block.size), block.shape])
    return block.effect, block.course, block.course.limited(theta, block.effect.lower, block.effect.upper)


def _range(block: Block) -> tuple[Array, Array]:
    """What the coefficients can be at least and at most. Far beyond a size that was tried memory is not linear."""
    effect, count = block.effect, block.columns.shape[1]
    lower, upper = (effect.lower, effect.upper) if not isinstance(block.course, Sine) else (-inf, inf)
    if block.size is not None:
        lower, upper = lower / block.size, min(upper / block.size, _MOST_SIZES)
    return np.full(count, lower), np.full(count, upper)


def _products(columns: Array) -> Array:
    """Of all columns with each other. A knot of a curve shows for a while only, and outside of it costs nothing."""
    sizes, products = np.abs(columns), np.zeros((columns.shape[1],) * 2)
    least = NEGLIGIBLE * np.max(sizes, axis=0)
    for begin in range(0, len(columns), BLOCK):
        part = slice(begin, begin + BLOCK)
        there = np.flatnonzero(np.max(sizes[part], axis=0) > least)
        shown = columns[part, there]
        products[np.ix_(there, there)] += shown.T @ shown
    return products


def _gain(columns: Array, w: Array) -> tuple[float, Array]:
    unbounded = np.full(columns.shape[1], inf)
    return within(columns.T @ columns, columns.T @ w, -unbounded, unbounded)


def _of_different_causes(blocks: Sequence[Block]) -> list[Block]:
    found: dict[str, Block] = {}
    for block in blocks:
        found.setdefault(block.effect.name, block)
    return list(found.values())
