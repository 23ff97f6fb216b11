"""One hypothesis: which effects are in the run, and with what kind of course; and its fit.

The loss is minus the log likelihood of the innovations of the extended model's filter, in the sense of Huber (1964,
Robust estimation of a location parameter, Annals of Mathematical Statistics 35): beyond `HUBER` standard deviations it
grows no faster than the deviation. The filter follows what is measured as far as its process noise lets it, and with
none it runs freely; so a start on the wrong branch or an extinguished plant leads no fit astray. The loss is lowered by
Gauss and Newton's steps, damped as Levenberg and Marquardt do, whose derivatives come from the equations of the
filter's own errors (`signatures`). Sizes that act in jumps have none, and are scanned (`grid_search`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.fault_filter import HUBER, Known, Sized, clipped
from reactorwatch.diagnosis.fitting.profiles import Course, Signal
from reactorwatch.diagnosis.parameter_priors import last_state, offsets
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.error_dynamics import ErrorDynamics
from reactorwatch.kalman.innovations import FilterResult

SETTLED, WELL_SETTLED = 0.05, 0.005
"""In log likelihood: a rough fit ends with a step that gains less, and any fit where none promises the second."""

MOST_STEPS = 12
"""Of a fit."""

_RUNAWAY = 1e100
"""A filter that lost an unstable plant has signatures without bound, and no step makes sense."""

_SHARE = 0.02
_WIDENINGS, _WIDER = 10, 2.0
_TRIES, _DAMPING, _MORE_DAMPING, _LESS_DAMPING = 5, 1e-3, 10.0, 0.1


@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis at some numbers, and what is left of the run there.

    Attributes:
        theta: of each effect, the coefficients and numbers of its course.
        loss: minus the log likelihood, up to a constant that all hypotheses share.
        w: whitened innovations, shape (rows, n_y); NaN where nothing was measured.
        found: the filter's run.
    """

    theta: tuple[Array, ...]
    loss: float
    w: Array
    found: FilterResult


class Hypothesis:
    """Some effects, each with a kind of course.

    Args:
        sized: the model with them in it.
        courses: one an effect.
    """

    def __init__(self, sized: Sized, courses: Sequence[Course]) -> None:
        self.sized, self.courses = sized, tuple(courses)

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.sized.effects)

    @property
    def freedom(self) -> int:
        """How many numbers are fitted."""
        return sum(course.freedom for course in self.courses)

    def at(self, run: Run, theta: Sequence[Array], like: Fit | None = None) -> Fit:
        """The nearest possible numbers, and what they make of the run.

        Args:
            run: the record.
            theta: of each effect.
            like: with other numbers and the noise that holds now; until theirs make a difference the filter runs alike.
        """
        return self.at_all(run, [theta], like)[0]

    def at_all(self, run: Run, several: Sequence[Sequence[Array]], like: Fit | None = None) -> list[Fit]:
        """As `at`, of several numbers, which together take less time."""
        possible = [self._limited(theta) for theta in several]
        signals = [self._signals(theta) for theta in possible]
        known = None
        if like is not None:
            before = self._signals(like.theta)
            known = [Known(like.found, _alike(item, before)) for item in signals]
        followed = self.sized.follow_all(run, signals, known)
        return [Fit(theta, *item) for theta, item in zip(possible, followed, strict=True)]

    def _limited(self, theta: Sequence[Array]) -> tuple[Array, ...]:
        return tuple(
            course.limited(numbers, effect.lower, effect.upper)
            for course, numbers, effect in zip(self.courses, theta, self.sized.effects, strict=True)
        )

    def fit(self, run: Run, start: Sequence[Array], steps: int = MOST_STEPS) -> Fit:
        """The best numbers that so many steps of least squares find from a start; sizes that act in jumps stay.

        Args:
            run: the record.
            start: where it begins, theta of each effect.
            steps: at most; fewer than `MOST_STEPS` are for a rough fit.
        """
        best = self.at(run, start)
        damping, enough = _DAMPING, WELL_SETTLED if steps == MOST_STEPS else SETTLED
        differences = self._least_differences()
        for _ in range(steps):
            with np.errstate(over="ignore", invalid="ignore"):
                g = self._slope(run, best, differences, rough=steps < MOST_STEPS)
            w = np.nan_to_num(best.w[2:]).ravel()
            if not np.any(g) or not np.max(np.abs(g)) < _RUNAWAY:
                break
            weights = HUBER / np.maximum(np.abs(w), HUBER)
            weighted = g * np.sqrt(weights)[:, None]
            information, gradient = weighted.T @ weighted + self._least_information(), g.T @ (weights * w)
            scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
            information, gradient = information / np.outer(scale, scale), gradient / scale
            before = best
            for _ in range(_TRIES):
                scaled = np.linalg.lstsq(information + damping * np.eye(scale.size), gradient, rcond=1e-12)[0]
                promised = float(scaled @ (gradient - 0.5 * information @ scaled))
                if promised < enough:
                    break
                trial = self.at(run, self._moved(best.theta, scaled / scale))
                if trial.loss < best.loss:
                    best, damping = trial, damping * _LESS_DAMPING
                    break
                damping *= _MORE_DAMPING
            gained = before.loss - best.loss
            # A whole step that gains what was promised leaves nothing to gain: all is as good as linear there.
            if gained < SETTLED or (damping < _DAMPING and abs(gained - promised) < enough):
                break
            if any(course.numbers for course in self.courses):
                differences = self._widened(self._inverse(g), differences)
        return best

    def covariance(self, run: Run, fit: Fit) -> Array:
        """Of all numbers in a row, shape (freedom, freedom).

        An onset matters only where something happens, so how the innovations change with it depends on how far it is
        moved. It is moved by about one standard deviation.
        """
        ways = None if self.sized.late is not None else self.sized.ways(run, self._signals(fit.theta), fit.found)
        differences = self._least_differences()
        for _ in range(_WIDENINGS):
            found = self._inverse(self._slope(run, fit, differences, ways))
            before, differences = differences, self._widened(found, differences)
            if all(np.array_equal(*pair) for pair in zip(before, differences, strict=True)):
                break
        return found

    def offsets(self, fit: Fit) -> dict[str, float]:
        """What the uncertain parameters of the plant are off by, by name."""
        return offsets(self.sized.model, fit.found.x[last_state(fit.found)])

    def offset_sds(self, run: Run, fit: Fit) -> dict[str, float]:
        """The standard deviations of these, whatever the numbers may be."""
        row = last_state(fit.found)
        variances = np.diag(fit.found.P[row]).copy()
        if self.freedom == 0:
            return offsets(self.sized.model, np.sqrt(variances))
        covariance = self.covariance(run, fit)
        changes = np.maximum(np.sqrt(np.maximum(np.diag(covariance), 0.0)), 1e-300)
        moved = [self._signals(self._moved(fit.theta, change)) for change in np.diag(changes)]
        there = np.array([item.found.x[row] for item in self.sized.follow_all(run, moved)])
        by = np.nan_to_num((there - fit.found.x[row]) / changes[:, None])
        return offsets(self.sized.model, np.sqrt(variances + np.einsum("ni,nm,mi->i", by, covariance, by)))

    def _inverse(self, g: Array) -> Array:
        """Covariance of the numbers whose derivatives these are."""
        information = g.T @ g + self._least_information()
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        inner = np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-12, hermitian=True)
        return np.asarray(inner / np.outer(scale, scale))

    def _least_information(self) -> Array:
        """What is known of the numbers beforehand: where they can be. Some records do not tell an onset at all."""
        widths = [self._widths(place) for place in range(len(self.courses))]
        return np.diag(np.concatenate(widths) ** -2.0)

    def _widths(self, place: int) -> Array:
        """Of where the numbers of an effect can be."""
        effect, course = self.sized.effects[place], self.courses[place]
        of_numbers = [number.upper - number.lower for number in course.numbers]
        return np.array([effect.upper - effect.lower] * course.coefficients + of_numbers)

    def _slope(
        self, run: Run, fit: Fit, differences: Sequence[Array], ways: ErrorDynamics | None = None, rough: bool = False
    ) -> Array:
        """What the whitened innovations lose as the numbers grow, shape (values from the third row on, freedom).

        Where an output is late, the equations of the filter's errors hold roughly for what is beside it. They know
        nothing of the rows in which a size that moves the clock grows, and these are all that tells its onset.
        """
        late = self.sized.late
        if ways is None and (late is None or (rough and len(self.courses) > 1)):
            ways = self.sized.ways(run, self._signals(fit.theta), fit.found)
        columns = []
        for place, (course, numbers, moved) in enumerate(zip(self.courses, fit.theta, differences, strict=True)):
            if place == late or ways is None:
                columns.append(self._slope_by_differences(run, fit, place, moved))
                continue
            apart = bool(course.numbers) and self.sized.moves_clock(place)
            shape = numbers[course.coefficients :]
            over_row, at_row = course.basis(shape) if apart else course.derivatives(numbers, moved)
            g = signatures.shown(ways, self.column(place), over_row[1:-1], at_row[2:])
            columns.append(g.reshape(-1, over_row.shape[1]))
            if apart:
                columns.append(self._slope_by_differences(run, fit, place, moved, course.coefficients))
        return np.concatenate(columns, axis=1)

    def _slope_by_differences(self, run: Run, fit: Fit, place: int, moved: Array, first: int = 0) -> Array:
        """By the numbers of one effect, from the first that is asked for on.

        What tells less of an onset than is known of it beforehand is no more than rounding, and leads astray.
        """
        course, signals = self.courses[place], []
        size = _SHARE * self.sized.effects[place].typical
        steps = [*(size,) * course.coefficients, *moved.tolist()]
        for number in range(first, course.freedom):
            theta = [item.copy() for item in fit.theta]
            theta[place][number] += steps[number]
            signals.append(self._signals(theta))
        as_it_is = self._signals(fit.theta)
        begun = [Known(fit.found, _alike(item, as_it_is)) for item in signals]
        before, followed = clipped(fit.w[2:]), self.sized.follow_all(run, signals, begun)
        moves = zip(steps[first:], followed, strict=True)
        found = np.stack([(before - clipped(item.w[2:])).ravel() / step for step, item in moves], axis=1)
        told = np.sum(found**2, axis=0) >= self._widths(place)[first:] ** -2.0
        told[: course.coefficients - first] = True
        return np.asarray(found * told)

    def signatures(self, run: Run, fit: Fit, place: int, course: Course) -> Array:
        """What the whitened innovations lose as the coefficients of another course of one of its effects grow.

        Args:
            run: the record.
            fit: where all is linearised.
            place: of the effect; not one that makes an output late.
            course: without numbers besides its coefficients.

        Returns:
            Shape (values from the third row on, coefficients).
        """
        ways = self.sized.ways(run, self._signals(fit.theta), fit.found)
        over_row, at_row = course.basis(np.empty(0))
        g = signatures.shown(ways, self.column(place), over_row[1:-1], at_row[2:])
        return g.reshape(-1, course.coefficients)

    def column(self, place: int) -> int:
        """Of an effect among the ways, which know nothing of the late output."""
        late = self.sized.late
        return place - (late is not None and late < place)

    def unexplained(self, run: Run, fit: Fit) -> float:
        """What no change of its numbers would take away of the innovations' sum of squares, linearised."""
        g, w = self._slope(run, fit, self._least_differences()), np.nan_to_num(fit.w[2:]).ravel()
        sought = g.T @ w
        return max(float(w @ w - sought @ self._inverse(g) @ sought), 0.0)

    def without(self, run: Run, fit: Fit, place: int) -> Array:
        """The whitened innovations of a filter that does not know one of the deviations, shape (rows, n_y)."""
        signals = self._signals(fit.theta)
        signals[place] = Signal(*(np.zeros_like(item) for item in signals[place]))
        return self.sized.follow(run, signals).w

    def _least_differences(self) -> list[Array]:
        return [course.least_differences for course in self.courses]

    def _widened(self, covariance: Array, differences: Sequence[Array]) -> list[Array]:
        """Wider differences where a standard deviation is, by not too much at once."""
        sds, found, begin = np.sqrt(np.maximum(np.diag(covariance), 0.0)), [], 0
        for course, before in zip(self.courses, differences, strict=True):
            numbers = sds[begin + course.coefficients : begin + course.freedom]
            found.append(np.maximum(before, np.minimum(numbers, _WIDER * before)))
            begin += course.freedom
        return found

    def signals(self, fit: Fit) -> list[Signal]:
        """The deviations."""
        return self._signals(fit.theta)

    def _signals(self, theta: Sequence[Array]) -> list[Signal]:
        return [course.signal(numbers) for course, numbers in zip(self.courses, theta, strict=True)]

    def _moved(self, theta: Sequence[Array], change: Array) -> list[Array]:
        moved, begin = [], 0
        for numbers in theta:
            moved.append(numbers + change[begin : begin + numbers.size])
            begin += numbers.size
        return moved


def _alike(one: Sequence[Signal], other: Sequence[Signal]) -> int:
    """How many rows there are before the first in which any deviation differs."""
    rows = len(one[0].at_row)
    differs = np.zeros(rows, dtype=np.bool_)
    for mine, theirs in zip(one, other, strict=True):
        differs |= (mine.over_row != theirs.over_row) | (mine.at_row != theirs.at_row)
    return int(np.argmax(differs)) if differs.any() else rows
