"""Explanations of a record by a plant that is never quite its model, compared with nuisance in each.

A small shift in time colours every residual, so that no cause leaves a white one, although the right cause removes
nearly all of the squared error. Here each hypothesis has the same nuisance (`nuisance`), and what is left is a coloured
discrepancy that is the same for all of them (`noise`): a cause that explains nearly everything sets the yardstick for
the others, and where even the best explains little, differences shrink by themselves. The plant is simulated, not
filtered, so nothing follows the measurements.

All causes are ranked by the linearised model (`screen`), the best are fitted (`fit`), and the discrepancy is estimated
again from the residual of the best; the model is then linearised again about its nuisance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.holdout import EVERY, blocks_of, excess, rms, share_of
from reactorwatch.diagnosis.inexact.fit import Fitted, Fitter
from reactorwatch.diagnosis.inexact.hypotheses import (
    CONSTANT,
    CURVE,
    NONE,
    RAMP,
    STEP,
    WIDTH,
    Courses,
    Hypothesis,
)
from reactorwatch.diagnosis.inexact.noise import Discrepancy, estimate_discrepancy, white, white_noise_sd
from reactorwatch.diagnosis.inexact.nuisance import Nuisance
from reactorwatch.diagnosis.inexact.screen import Screen
from reactorwatch.diagnosis.inexact.simulation import InexactSimulation, ProductForcing, Simulated, Slopes
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.signal_effects import InputDelay, InputLag, OutputDelay, OutputLag
from reactorwatch.progress import report_stage, track

ROUNDS = 2
"""Estimates of the discrepancy."""

FIRST, LAST, A_CAUSE = 2, 7, 2
"""Hypotheses with a cause that are fitted in each round beside a curve, in the last one, and of one cause there."""

ALIKE = 1e-3
"""Difference in log evidence, by the linearised model, of hypotheses that do the same: that of rounding is smaller."""

SAME = 1e-6
"""Squared difference of the residuals of two causes, over the residual's square, below which they do the same: one
explanation with two names."""

KNOWN_SHARE = 0.03
"""Standard deviation of a size, as a share of it, where constants had to be moved by their typical sizes."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """A cause beside nuisance, or nuisance alone.

    Attributes:
        effect: the cause; None: none.
        same: explanations by other effects that do the same in this record.
        fitted: the fit.
        size_sd: standard deviation of the size, with what the nuisance leaves open of it.
        share: share of the squared simulation error beyond noise and nuisance that it removes on held-out rows.
        probability: probability among all explanations, times what it explains.
        left: root mean square error on held-out rows beyond the noise, by output, shape (n_y,).
        effect_size: root mean square difference between simulations with and without it, by output, shape (n_y,).
    """

    effect: Effect | None
    same: tuple["Explanation", ...]
    fitted: Fitted
    size_sd: float
    share: float
    probability: float
    left: Array
    effect_size: Array

    @property
    def log_evidence(self) -> float:
        """Logarithm of the evidence."""
        return self.fitted.log_evidence


@dataclass(frozen=True, eq=False)
class Explained:
    """All explanations of a record.

    Attributes:
        explanations: those with a cause, the likeliest first.
        none: nuisance alone.
        nuisance: layout of the nuisance.
        courses: courses in time.
        noise_sd: standard deviation of the white noise of each output, shape (n_y,).
    """

    explanations: tuple[Explanation, ...]
    none: Explanation
    nuisance: Nuisance
    courses: Courses
    noise_sd: Array


def explain(
    model: ProcessModel,
    effects: Sequence[Effect],
    run: Run,
    starts: Array,
    stated: Mapping[str, float],
    smallest_sd: Sequence[float],
) -> Explained | None:
    """Compare all explanations of a run; None without any, or where even the model without a cause diverges.

    Args:
        model: process model of the plant, without priors.
        effects: effects that may be named.
        run: the record.
        starts: usual states at the first row of each part, shape (parts, n_x).
        stated: standard deviations of parameters, in their units; 0: exact.
        smallest_sd: lower bound of each sensor's noise.
    """
    return _Comparison(model, effects, run, starts, stated, np.asarray(smallest_sd)).run_rounds()


class _Linear(NamedTuple):
    """A model linearised about a simulation.

    Attributes:
        theta: nuisance of the simulation, shape (size,).
        residual: residual at the kept rows, 0 where not measured, shape (kept rows, n_y).
        base: derivatives of the readings by all nuisance, shape (kept rows, n_y, size).
        causes: derivatives by every effect in all steps, then hats, shape (kept rows, n_y, effects * courses).
        slopes: derivatives along the simulation.
    """

    theta: Array
    residual: Array
    base: Array
    causes: Array
    slopes: Slopes


class _Comparison:
    """The rounds of `explain`, whose arguments it takes."""

    def __init__(
        self,
        model: ProcessModel,
        effects: Sequence[Effect],
        run: Run,
        starts: Array,
        stated: Mapping[str, float],
        smallest_sd: Array,
    ) -> None:
        self._run, self._smallest_sd = run, smallest_sd
        self._simulation = InexactSimulation(model, effects, run, starts[0])
        self._nuisance = Nuisance(self._simulation, starts, stated)
        courses = self._courses = Courses(run.time_min, run.period_min)
        self._causes = self._causes_of_nuisance(effects)
        self._rows = self._simulation.rows
        widths = {index: WIDTH * abs(effect.typical) for index, effect in self._causes.items()}
        self._widths = widths
        self._fitter = Fitter(self._nuisance, courses, widths, run.measured[self._rows])

    def _causes_of_nuisance(self, effects: Sequence[Effect]) -> dict[int, Effect]:
        """Effect by the index of the nuisance that does the same, constantly."""
        nuisance, model = self._nuisance, self._simulation.model
        result = dict(enumerate(self._simulation.effects, start=nuisance.effects.start))
        for effect in effects:
            if isinstance(effect, (InputDelay, InputLag)):
                first = nuisance.input_delays if isinstance(effect, InputDelay) else nuisance.input_lags
                result[first.start + model.input_names.index(effect.input)] = effect
            elif isinstance(effect, (OutputDelay, OutputLag)):
                first = nuisance.output_delays if isinstance(effect, OutputDelay) else nuisance.output_lags
                result[first.start + model.output_names.index(effect.output)] = effect
        return result

    def run_rounds(self) -> Explained | None:
        """Rank, fit and estimate the discrepancy in turn."""
        theta = np.zeros(self._nuisance.size)
        simulated = self._nuisance.simulate(theta)
        if simulated is None or not self._simulation.effects:
            return None
        residual = self._fitter.residual(theta, simulated)
        noise = white(np.maximum(np.sqrt(np.mean(residual**2, axis=0)), self._smallest_sd))
        for number in range(1, ROUNDS + 1):
            report_stage("comparing with nuisance, round", number, ROUNDS + 1)
            linear = self._linearise(theta, simulated)
            ranked = self._rank(linear, noise)
            chosen = _choose_first(ranked)
            if number == 1:  # a sensor's jump stands out of what wanders, where that is no white noise
                coloured = estimate_discrepancy(residual, self._smallest_sd)
                chosen = _add_causes(chosen, ranked, _choose_first(self._rank(linear, coloured)))
            fits = self._fit_all(chosen, theta, noise, slow=True)
            if not fits:
                return None
            best, noise = max(
                ((item, estimate_discrepancy(item.residual, self._smallest_sd)) for item in fits),
                key=lambda pair: pair[0].log_evidence_with(pair[1]),
            )
            theta = best.theta.copy()
            if best.hypothesis.kind in (STEP, RAMP):
                self._courses = replace(self._courses, expected_min=best.hypothesis.onset)
            if best.hypothesis.kind == CONSTANT:
                theta[best.hypothesis.effect] = 0.0
            again = self._nuisance.simulate(theta)
            if again is None:
                return None
            simulated = again
        report_stage("comparing with nuisance, round", ROUNDS + 1, ROUNDS + 1)
        fits = self._fit_all(_choose(self._rank(self._linearise(theta, simulated), noise), LAST), theta, noise)
        return self._explanations(fits, noise) if any(item.hypothesis.kind == NONE for item in fits) else None

    def _linearise(self, theta: Array, simulated: Simulated) -> _Linear:
        """Derivatives of the readings at the kept rows about a simulation."""
        sim, nuisance = self._simulation, self._nuisance
        found = nuisance.linearise(theta, simulated)
        steps, hats = self._courses.steps(), self._courses.hats()
        courses = Signal(
            np.hstack([steps.interval_mean, hats.interval_mean]), np.hstack([steps.sample_value, hats.sample_value])
        )
        starts = np.zeros((len(sim.begins), len(sim.model.states), len(sim.effects) * courses.interval_mean.shape[1]))
        causes = nuisance.derivatives(theta, found.slopes, starts, ProductForcing(courses))
        residual, mask = self._fitter.residual(theta, simulated), self._fitter.mask
        return _Linear(theta, residual, mask(found.derivatives), mask(causes), found.slopes)

    def _rank(self, linear: _Linear, noise: Discrepancy) -> list[Hypothesis]:
        """All hypotheses by the linearised model, the likeliest first."""
        sim, nuisance, slopes = self._simulation, self._nuisance, linear.slopes
        whitened, base, causes = (noise.whiten(item) for item in (linear.residual, linear.base, linear.causes))
        values = whitened.size
        screen = Screen(
            nuisance,
            self._courses,
            self._widths,
            linear.theta,
            whitened.ravel(),
            base.reshape(values, -1),
            causes.reshape(values, len(sim.effects), -1),
        )
        ranked, times = screen.rank(), self._run.time_min[self._rows]
        for effect in np.flatnonzero(~np.any(slopes.b, axis=(0, 1))).tolist():  # errors of sensors
            shows = np.any(slopes.d[:, :, effect], axis=0)
            columns = slopes.d[self._rows, :, effect, None] * (times[:, None] >= times)[:, None, :]
            jumps = noise.of(shows).whiten(self._fitter.mask(columns)[:, shows])
            given = np.tile(shows, len(times))
            ranked = screen.refine(ranked, effect, times, jumps.reshape(-1, times.size), given)
        return ranked

    def _fit_all(
        self, chosen: Sequence[Hypothesis], theta: Array, noise: Discrepancy, *, slow: bool = False
    ) -> list[Fitted]:
        """Fit hypotheses; with `slow` also from slow sensors, if these are possible."""
        late = theta.copy()
        late[self._nuisance.output_lags] = self._nuisance.lag_start_min
        result = []
        for item in track("fitting with nuisance, hypothesis", chosen):
            starts = [theta, late] if slow and item.prior.lam == 1.0 else [theta]
            fits = [fit for start in starts if (fit := self._fitter.fit(item, start, noise)) is not None]
            result += [max(fits, key=lambda fit: fit.log_evidence)] if fits else []
        return result

    def _explanations(self, fits: Sequence[Fitted], noise: Discrepancy) -> Explained:
        """Shares and probabilities of the fits of the last round."""
        noise_sd = np.maximum(white_noise_sd(self._run.measured, noise), self._smallest_sd)
        none = next(item for item in fits if item.hypothesis.kind == NONE)
        top = max(item.log_evidence for item in fits)
        total = sum(exp(item.log_evidence - top) for item in fits)
        result: list[Explanation] = []
        for item in sorted(fits, key=lambda item: -item.log_evidence):
            folds = self._folds(item.hypothesis)
            before, after = (self._error(each, folds) for each in (none, item))
            share, left = share_of(before, after, noise_sd), excess(after, noise_sd)
            effect = None if item is none else self._effect(item.hypothesis)
            prior = item.hypothesis.prior
            size_sd = float(np.hypot(item.size_sd, KNOWN_SHARE * max(prior.kappa, prior.lam) * item.hypothesis.size))
            probability = share**2 * exp(item.log_evidence - top) / total
            result.append(Explanation(effect, (), item, size_sd, share, probability, left, self._effect_size(item)))
        causes = self._join([item for item in result if item.effect is not None])
        alone = next(item for item in result if item.effect is None)
        return Explained(tuple(causes), alone, self._nuisance, self._courses, noise_sd)

    def _effect(self, hypothesis: Hypothesis) -> Effect:
        if hypothesis.kind == CONSTANT:
            return self._causes[hypothesis.effect]
        return self._simulation.effects[hypothesis.effect]

    def _folds(self, hypothesis: Hypothesis) -> list[NDArray[np.bool_]]:
        """Masks of the kept rows, each to be predicted from all others; together they are all rows but a few.

        Blocks in which the plant starts, or the cause sets in, are in none, because no others determine that.
        """
        run = self._run
        block, begins = blocks_of(run, run.time_min[self._rows]), run.time_min[list(self._simulation.begins)]
        onset = [hypothesis.onset] if hypothesis.kind in (STEP, RAMP) else []
        foldable = ~np.isin(block, blocks_of(run, np.append(begins, onset)))
        return [foldable & (block % EVERY == fold) for fold in range(EVERY)]

    def _error(self, item: Fitted, folds: Sequence[NDArray[np.bool_]]) -> Array:
        """Root mean square error of the predictions of the folds, by output."""
        known, errors = np.isfinite(self._run.measured[self._rows]), np.full(item.residual.shape, np.nan)
        for fold in folds:
            errors[fold] = item.residual_without(fold)
        return np.nan_to_num(rms(np.where(known, errors, np.nan)))

    def _effect_size(self, item: Fitted) -> Array:
        """Root mean square difference between the simulations with and without the cause, by output."""
        theta = item.theta.copy()
        if item.hypothesis.kind == CONSTANT:
            theta[item.hypothesis.effect] = 0.0
        without = self._nuisance.simulate(theta)
        if without is None:
            return np.full(item.residual.shape[1], np.inf)
        difference = self._nuisance.read(item.simulated, item.theta) - self._nuisance.read(without, theta)
        return np.asarray(np.sqrt(np.mean(difference**2, axis=0)))

    def _join(self, items: Sequence[Explanation]) -> list[Explanation]:
        """Explanations by different causes, of which those that do the same are one."""
        result: list[Explanation] = []
        for item in items:
            for number, other in enumerate(result):
                if item.effect in (other.effect, *(same.effect for same in other.same)):
                    break
                if self._does_the_same(item, other):
                    result[number] = replace(other, same=(*other.same, item))
                    break
            else:
                result.append(item)
        return result

    def _does_the_same(self, one: Explanation, other: Explanation) -> bool:
        """True if the two causes change the outputs in the same way, and fit equally well."""
        if one.fitted.hypothesis.kind != other.fitted.hypothesis.kind or one.fitted.hypothesis.kind == CURVE:
            return False
        a, b = (item.fitted.residual.ravel() for item in (one, other))
        return bool(np.sum((a - b) ** 2) < SAME * np.sum(a**2))


def _choose(ranked: Sequence[Hypothesis], count: int) -> list[Hypothesis]:
    """No cause, and the likeliest hypotheses with one."""
    none = next(item for item in ranked if item.kind == NONE)
    chosen: dict[tuple[str, int], Hypothesis] = {}
    for item in ranked:
        same = sum(index == item.effect for _, index in chosen)
        if item.kind != NONE and item.cause not in chosen and same < A_CAUSE and len(chosen) < count:
            chosen[item.cause] = item
    return [none, *chosen.values()]


def _choose_first(ranked: Sequence[Hypothesis]) -> list[Hypothesis]:
    """No cause, the likeliest curve and the likeliest hypotheses of other profiles, of those that do the same one.

    Of these the discrepancy is estimated. A curve imitates what wanders, and in white noise it is likelier than any
    cause that does not.
    """
    chosen: list[Hypothesis] = []
    for item in ranked:
        alike = sum((other.kind == CURVE) == (item.kind == CURVE) for other in chosen)
        is_open = item.kind != NONE and alike < (1 if item.kind == CURVE else FIRST)
        if is_open and not any(_seem_the_same(item, other) for other in chosen):
            chosen.append(item)
    return [next(item for item in ranked if item.kind == NONE), *chosen]


def _add_causes(
    chosen: Sequence[Hypothesis], ranked: Sequence[Hypothesis], others: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Hypotheses, and those of a ranking with the causes and courses of others."""
    result = list(chosen)
    for other in others:
        if not any(_seem_the_same(other, item) for item in chosen):
            same = next(item for item in ranked if item.cause == other.cause)
            result.append(same._replace(onset=other.onset, size=other.size))
    return result


def _seem_the_same(one: Hypothesis, other: Hypothesis) -> bool:
    """True of one cause with two priors, and of twins, such as the gains of a pump and of its signal."""
    are_twins = one.onset == other.onset and abs(one.log_evidence - other.log_evidence) < ALIKE
    return one.cause == other.cause or (one.kind == other.kind and are_twins)
