"""Numbers in which the likelihood is rough: when something set in, and how far a valve sticks.

The loss is no parabola in them. A sensor shows the same wherever between two rows it went wrong; a lag is seen only
where the input moves; a valve that sticks does the same for a whole range of sizes; and a fit can stay in a hollow
between two moves. So about the best fit such a number is moved by hand, the others held, and the likelihood is taken
for its distribution (Sivia & Skilling 2006, Data Analysis: A Bayesian Tutorial, 2.2). The mean is the estimate, if it
is about as likely as the likeliest; the root mean square distance from the estimate is the standard deviation.

Effects with a memory of their own have been looked for at a few sizes only (`dynamic_effects_screen`). For their steps
all onsets are tried at once: such memory is short, so before the onset the innovations are those of a filter without
the effect, and after it those of one that has had it from the beginning.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES
from reactorwatch.diagnosis.fitting.fault_filter import row_losses
from reactorwatch.diagnosis.fitting.hypothesis import Fit
from reactorwatch.diagnosis.fitting.profiles import Step
from reactorwatch.diagnosis.search.search import Explained, Search

OFFSETS = (0.5, 1.0, 2.0)
"""To either side, in standard deviations that the fit has found, and at least rows."""

WIDENINGS, ROUNDS = 7, 3
OUT_OF_QUESTION = 7.0
"""In log likelihood: a value that is worse by more adds nothing, and behind it no other hump is looked for."""

LEAST_GAIN, AS_LIKELY = 0.1, 0.5
"""In log likelihood: by so much more a value is taken for the likeliest; by so much less it is still as good."""

FAR_BETWEEN, UNSURE, MOST_MORE, FINER = 1.01, 0.08, 12, 20
"""In the first look's reaches, what is far between values in question; of the whole, how much of the likelihood may lie
here or there between two values; how many more are tried for each; and steps between two values tried."""

HOLLOWS, APART_ROWS = 3, 20
"""How many onsets of effects with memory are tried, and by how much they differ."""

WITHIN_ROW = 0.15
"""Of a row, the least standard deviation of an onset: what acts in part of a row is taken for its mean over the row."""

LARGEST_SHARE = 0.05
"""Of the record, for the first look to either side."""

SIZE_SHARE = 0.005
"""Of a size that acts in jumps, likewise."""


def settled(search: Search, best: Explained, sds: Sequence[Array]) -> tuple[Explained, list[dict[int, float]]]:
    """The best explanation, with its rough numbers where the record is likeliest, and their standard deviations.

    Args:
        search: that found it.
        best: with some effects, or none.
        sds: standard deviations of each effect's numbers, by the fit.

    Returns:
        The explanation; of each effect, the standard deviations of its rough numbers, by their places.
    """
    found = []
    for place, (effect, course) in enumerate(zip(best.hypothesis.sized.effects, best.hypothesis.courses, strict=True)):
        rough: dict[int, float] = {}
        names = [item.name for item in course.numbers]
        if effect.is_discontinuous and course.coefficients == 1:
            reach = SIZE_SHARE * abs(float(best.fit.theta[place][0]))
            best, rough[0] = _Scan(search, place, 0, reach, (effect.lower, effect.upper)).settled(best)
        if "onset" in names:
            if isinstance(course, Step) and effect in search.screen.with_memory:
                best = _out_of_the_hollow(search, best, place)
            number = course.coefficients + names.index("onset")
            # Of what acts in jumps there are no derivatives, and no standard deviation follows from them.
            sd = 0.0 if effect.is_discontinuous else float(sds[place][number])
            reach = min(float(np.hypot(sd, course.period_min)), LARGEST_SHARE * search.run.span_min)
            bounds = (course.begin_min, course.end_min)
            best, sd = _Scan(search, place, number, reach, bounds).settled(best)
            rough[number] = max(sd, WITHIN_ROW * course.period_min)
        found.append(rough)
    return best, found


def _out_of_the_hollow(search: Search, best: Explained, place: int) -> Explained:
    """The best of the onsets at which the innovations with the effect begin to be better than those without it."""
    run, hypothesis = search.run, best.hypothesis
    without = row_losses(hypothesis.without(run, best.fit, place))
    with_it = row_losses(_at(search, best, place, 1, float(run.time_min[0])).w)
    total = np.cumsum(without) + np.cumsum(with_it[::-1])[::-1] - with_it
    for _ in range(HOLLOWS):
        row = int(np.argmin(total))
        trial = _at(search, best, place, 1, float(run.time_min[row]))
        if trial.loss < best.fit.loss - LEAST_GAIN:
            best = search.fit(hypothesis, trial.theta)
        total[max(row - APART_ROWS, 0) : row + APART_ROWS] = np.inf
    return best


class _Scan:
    """The likelihood along one number.

    Args:
        search: for the run.
        place: of the effect.
        number: place of the number among those of its course.
        reach: how far to look first.
        bounds: of the number.
    """

    def __init__(self, search: Search, place: int, number: int, reach: float, bounds: tuple[float, float]) -> None:
        self._search, self._place, self._number, self._reach, self._bounds = search, place, number, reach, bounds

    def settled(self, best: Explained) -> tuple[Explained, float]:
        """The best with the number where the record is likeliest near by, and its standard deviation."""
        for _ in range(ROUNDS):
            here = float(best.fit.theta[self._place][self._number])
            known = {here: best.fit}
            far = OFFSETS[-1] * self._reach
            sides = [list(self._to_a_side(here, side)) for side in (-1.0, 1.0)]
            self._try(best, known, [value for side in sides for value in side if abs(value - here) <= far])
            further = [[value for value in side if abs(value - here) > far] for side in sides]
            while further := [side for side in further if side]:
                self._try(best, known, [side[0] for side in further])
                further = [side[1:] for side in further if known[side[0]].loss <= best.fit.loss + OUT_OF_QUESTION]
            likeliest = min(known.values(), key=lambda item: item.loss)
            if likeliest.loss > best.fit.loss - LEAST_GAIN:
                break
            best = self._search.fit(best.hypothesis, likeliest.theta)
        self._look_between(best, known)
        mean, _ = _moments(known, here)
        trial = _at(self._search, best, self._place, self._number, mean)
        if trial.loss < best.fit.loss + AS_LIKELY:
            best, here = self._search.judged(best.hypothesis, trial), mean
        return best, _moments(known, here)[1]

    def _look_between(self, best: Explained, known: dict[float, Fit]) -> None:
        """Try more values where another hump may be: far between such as are in question, and where it is steep."""
        for _ in range(MOST_MORE // LANES):
            values, above = self._values(best, known)
            width = np.where(np.maximum(above[1:], above[:-1]) < OUT_OF_QUESTION, np.diff(values), 0.0)
            if not self._halved(best, known, width, FAR_BETWEEN * self._reach):
                break
        for _ in range(MOST_MORE // LANES):
            values, above = self._values(best, known)
            likelihood = np.exp(-above)
            unsure = np.diff(values) * np.abs(np.diff(likelihood))
            if not self._halved(best, known, unsure, UNSURE * float(np.trapezoid(likelihood, values))):
                break

    def _values(self, best: Explained, known: dict[float, Fit]) -> tuple[Array, Array]:
        """Those that were tried, in order, and how much worse than the best they are in log likelihood."""
        values = sorted(known)
        return np.array(values), np.array([known[value].loss - best.fit.loss for value in values])

    def _halved(self, best: Explained, known: dict[float, Fit], of_each: Array, least: float) -> bool:
        """Try values in the middle between two, where there is most of something; whether there is enough of it."""
        values, most = sorted(known), np.argsort(-of_each)[:LANES].tolist()
        middles = [0.5 * (values[place] + values[place + 1]) for place in most if of_each[place] > least]
        self._try(best, known, middles)
        return bool(middles)

    def _try(self, best: Explained, known: dict[float, Fit], values: Sequence[float]) -> None:
        known.update(zip(values, _at_all(self._search, best, self._place, self._number, values), strict=True))

    def _to_a_side(self, here: float, side: float) -> Iterator[float]:
        """Values to try, within the bounds, further and further away."""
        offsets = [*OFFSETS, *(OFFSETS[-1] * 2.0**power for power in range(1, WIDENINGS + 1))]
        before = here
        for offset in offsets:
            value = min(max(here + side * offset * self._reach, self._bounds[0]), self._bounds[1])
            if value != before:
                yield value
            before = value


def _moments(known: dict[float, Fit], here: float) -> tuple[float, float]:
    """Of the likelihood along a number: the mean, and the root mean square distance from a value."""
    tried = sorted(known)
    fine = [np.linspace(*pair, FINER, endpoint=False) for pair in pairwise(tried)]
    values = np.array([*np.concatenate(fine), tried[-1]]) if fine else np.array(tried)
    losses = np.interp(values, tried, [known[item].loss for item in tried])
    likelihood = np.exp(-(losses - losses.min()))
    total = float(np.trapezoid(likelihood, values))
    if total <= 0.0:  # between two bounds that are one
        return here, 0.0
    mean, square = (float(np.trapezoid(likelihood * item, values)) / total for item in (values, (values - here) ** 2))
    return mean, square**0.5


def _at(search: Search, best: Explained, place: int, number: int, value: float) -> Fit:
    return _at_all(search, best, place, number, [value])[0]


def _at_all(search: Search, best: Explained, place: int, number: int, values: Sequence[float]) -> list[Fit]:
    """With one number of one effect exchanged; together they take less time."""
    thetas = [[item.copy() for item in best.fit.theta] for _ in values]
    for theta, value in zip(thetas, values, strict=True):
        theta[place][number] = value
    return best.hypothesis.at_all(search.run, thetas)
