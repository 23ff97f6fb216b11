"""Lasting explanations, fitted as simulations and compared on held-out rows.

A filter with much process noise follows the measurements whatever its model lacks, so its likelihood hardly
distinguishes a cause that lasts from one that drifts with the error of the model. Where the best explanation needs such
noise, causes that are there from the beginning and stay are fitted once more without process noise, together with the
uncertain parameters. A model with uncertain parameters may lack several terms that last; so further causes are added
to the best one by one, as long as each makes the simulation of held-out rows much better. If the result simulates
held-out rows better than the explanation that drifts, each fitted to the other rows, it is the better explanation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.descent import Equations, descend
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter, FilterEvaluation
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant
from reactorwatch.diagnosis.fitting.simulation import FittedSimulation
from reactorwatch.diagnosis.holdout import evaluate_holdout, holdout_rows, is_near_noise, rms
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis, Search, SearchResult
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.progress import track

BETTER = 0.95
"""Ratio of held-out errors below which one explanation simulates better than another."""

MUCH_BETTER, FAR = 0.85, 2.0
"""Ratio of held-out errors below which a further cause is added, and beyond which none is tried."""

MOST_CAUSES, MOST_TOGETHER, BRANCHES = 8, 3, 2
"""Number of single causes that are fitted, of causes in one explanation, and of explanations to which one is added."""

FIRST_STEPS, STEPS, ROUNDS = 4, 12, 2
"""Steps from each start, from the best start, and estimates of the error's size."""


@dataclass(frozen=True, eq=False)
class LastingFit:
    """Lasting causes fitted as a simulation.

    Attributes:
        effects: the causes.
        values: sizes, constants of the effects and uncertain parameters, by name in the extended model.
        sds: their standard deviations, if the errors of the simulation were white.
        error_sd: root mean square error of a fit to all rows, shape (n_y,).
        held_out: root mean square error on held-out rows, of a fit to the others, shape (n_y,).
    """

    effects: tuple[Effect, ...]
    values: Mapping[str, float]
    sds: Mapping[str, float]
    error_sd: Array
    held_out: Array


class LastingResult(NamedTuple):
    """Lasting explanations that take the place of a search's result.

    Attributes:
        result: hypotheses about a model with the estimated values of its uncertain parameters, the best first.
        sds: standard deviations of these parameters, by name.
    """

    result: SearchResult
    sds: Mapping[str, float]


def prefer_lasting(
    search: Search, result: SearchResult, best: FittedHypothesis, model: ProcessModel, uncertain: Mapping[str, float]
) -> LastingResult | None:
    """Result with lasting explanations if one simulates held-out rows better than the best hypothesis; else None.

    Args:
        search: search of the run.
        result: result of the search.
        best: best hypothesis.
        model: process model without priors.
        uncertain: standard deviations of its uncertain parameters.
    """
    run = search.run
    errors = evaluate_holdout(run, result.nominal, best)[1]
    if is_near_noise(errors, result.noise.sensor_sd(model.output_names)):
        return None
    drifting = errors.simulation
    causes = _likely_causes(search, result)
    fits = [fit_lasting(model, (effect,), uncertain, run) for effect in track("fitting lasting cause", causes)]
    usable = [item for item in fits if item is not None]
    if not usable:
        return None
    equal: Sequence[LastingFit] = sorted(usable, key=_mean_error)
    if uncertain and _worst(equal[0].held_out, drifting) < FAR:
        equal = _add_causes(equal, causes, model, uncertain, run)
    if not _worst(equal[0].held_out, drifting) < BETTER:
        return None
    near = [item for item in equal[1:] if _worst(equal[0].error_sd, item.error_sd) >= BETTER]
    return _as_result(search, [equal[0], *near], model, uncertain)


def _add_causes(
    fits: Sequence[LastingFit], causes: Sequence[Effect], model: ProcessModel, uncertain: Mapping[str, float], run: Run
) -> Sequence[LastingFit]:
    """Fits with further causes, as long as one makes the simulation of held-out rows much better; the best first."""
    while len(fits[0].effects) < MOST_TOGETHER:
        longer: dict[frozenset[Effect], LastingFit] = {}
        for base, effect in product(fits[:BRANCHES], causes):
            together = frozenset((*base.effects, effect))
            if effect not in base.effects and together not in longer:
                fit = fit_lasting(model, (*base.effects, effect), uncertain, run, base.values)
                if fit is not None:
                    longer[together] = fit
        ranked = sorted(longer.values(), key=_mean_error)
        if not ranked or not _worst(ranked[0].held_out, fits[0].held_out) < MUCH_BETTER:
            break
        fits = ranked
    return fits


def _mean_error(fit: LastingFit) -> float:
    """Mean logarithm of the errors of a fit to all rows."""
    return float(np.mean(np.log(fit.error_sd)))


def _worst(errors: Array, others: Array) -> float:
    """Largest ratio of errors; a simulation that diverged has an infinite one."""
    ratios = np.where(np.isfinite(errors), errors, np.inf) / np.where(np.isfinite(others), others, np.inf)
    return float(np.max(np.nan_to_num(ratios, nan=np.inf)))


def _likely_causes(search: Search, result: SearchResult) -> list[Effect]:
    """Causes of the best hypotheses, then others of the catalogue whose size has a derivative."""
    ranked = [effect for item in result.hypotheses for effect in item.hypothesis.filter.effects]
    usable = [
        effect
        for effect in dict.fromkeys([*ranked, *search.screen.static_effects])
        if effect.has_derivative and effect.delays_output is None and not effect.is_source
    ]
    return usable[:MOST_CAUSES]


def fit_lasting(
    model: ProcessModel,
    effects: tuple[Effect, ...],
    uncertain: Mapping[str, float],
    run: Run,
    start: Mapping[str, float] | None = None,
) -> LastingFit | None:
    """Fit constant deviations and the uncertain parameters as a simulation; None if that diverges.

    Args:
        model: process model of the plant.
        effects: the causes.
        uncertain: standard deviations of uncertain parameters, by name.
        run: the record.
        start: values of a fit without the last cause.
    """
    fitter = _SimulationFitter(model, effects, uncertain, run, start or {})
    fitted = fitter.fit()
    if fitted is None:
        return None
    hidden = holdout_rows(run).astype(np.bool_)
    without = fitter.fit_without(hidden, fitted.p)
    errors, unseen = (run.measured - item.evaluation.innovations.prediction for item in (fitted, without))
    values = dict(zip(fitter.names, fitted.p.tolist(), strict=True))
    sds = dict(zip(fitter.names, fitter.sds(fitted).tolist(), strict=True))
    return LastingFit(effects, values, sds, _rms(errors), _rms(unseen[hidden]))


@dataclass(frozen=True, eq=False)
class _Point:
    """Parameters, the run of the simulation with them, and the loss with their priors."""

    p: Array
    evaluation: FilterEvaluation
    loss: float


class _SimulationFitter:
    """Least squares of a simulation's error, with priors and bounds."""

    def __init__(
        self,
        model: ProcessModel,
        effects: Sequence[Effect],
        uncertain: Mapping[str, float],
        run: Run,
        known: Mapping[str, float],
    ) -> None:
        extended = model
        for effect in effects:
            extended = effect.extend(extended)
        self.names = (*(name for effect in effects for name in _names(effect)), *uncertain)
        parameters = [extended.parameter(name) for name in self.names]
        self._lower = np.array([item.lower for item in parameters])
        self._upper = np.array([item.upper for item in parameters])
        self._mean = np.array([item.value for item in parameters])
        sds = {name: sd for effect in effects for name, sd in _prior_sds(effect).items()} | dict(uncertain)
        self._weight = np.array([sds[name] for name in self.names]) ** -2.0
        start = np.array([known.get(name, mean) for name, mean in zip(self.names, self._mean, strict=True)])
        first = self.names.index(_names(effects[-1])[0])
        shifts = [np.zeros(start.size)] if known else _shifts(self.names, uncertain)
        self._first = [
            np.clip(near + shift, self._lower, self._upper)
            for near in _starts(effects[-1], start, first)
            for shift in shifts
        ]
        sd = [max(float(np.nanstd(column)), 1e-12) for column in run.measured.T]
        self._simulation = FittedSimulation(extended, self.names, run, _sensor_noise(sd, extended))

    def fit(self) -> _Point | None:
        """The best fit; None if every start diverges."""
        tried = [item for item in (self._climb(start, FIRST_STEPS) for start in self._first) if item is not None]
        if not tried:
            return None
        best = min(tried, key=lambda item: item.loss)
        for _ in range(ROUNDS):
            residual = self._simulation.run.measured - best.evaluation.innovations.prediction
            ekf = self._simulation.ekf
            ekf.noise = _sensor_noise(np.maximum(_rms(residual), 1e-12).tolist(), ekf.model)
            best = self._climb(best.p, STEPS) or best
        return best

    def sds(self, point: _Point) -> Array:
        """Standard deviations of the parameters at a fit."""
        return np.sqrt(np.diag(np.linalg.pinv(self._normal_equations(point)[0], hermitian=True)))

    def fit_without(self, hidden: NDArray[np.bool_], start: Array) -> _Point:
        """Fit to the other rows."""
        whole = self._simulation.run
        self._simulation.run = replace(whole, measured=np.where(hidden[:, None], np.nan, whole.measured))
        fitted = self._climb(start, STEPS)
        self._simulation.run = whole
        return self._evaluate(start) if fitted is None else fitted

    def _climb(self, p: Array, steps: int) -> _Point | None:
        """Descend from a start; None if the simulation diverges there."""
        start = self._evaluate(p)
        if not np.all(np.isfinite(start.evaluation.innovations.prediction[1:])):
            return None
        return descend(start, self._normal_equations, self._move, steps)

    def _move(self, point: _Point, step: Array) -> _Point:
        return self._evaluate(np.clip(point.p + step, self._lower, self._upper))

    def _evaluate(self, p: Array) -> _Point:
        evaluation = self._simulation.evaluate(self._values(p))
        return _Point(p, evaluation, evaluation.loss + 0.5 * float(np.sum(self._weight * (p - self._mean) ** 2)))

    def _values(self, p: Array) -> dict[str, float]:
        return dict(zip(self.names, p.tolist(), strict=True))

    def _normal_equations(self, point: _Point) -> Equations:
        information, gradient = self._simulation.normal_equations(self._values(point.p), point.evaluation)
        return information + np.diag(self._weight), gradient - self._weight * (point.p - self._mean)


def _names(effect: Effect) -> tuple[str, ...]:
    """Names of the size and the constants of an effect in a model that it extends once."""
    return (f"{effect.name}.size", *(f"{effect.name}.{item.name}" for item in effect.constants))


def _prior_sds(effect: Effect) -> dict[str, float]:
    """Standard deviations of the priors of an effect's size and constants."""
    sds = (effect.upper - effect.lower, *(item.sd for item in effect.constants))
    return dict(zip(_names(effect), sds, strict=True))


def _starts(effect: Effect, values: Array, first: int) -> list[Array]:
    """Initial parameters: the neutral size; of an effect with constants a typical one, at all their start values.

    The effect's parameters begin at the index `first` of the values.
    """
    if not effect.constants and not effect.start_values:
        return [values]
    result = []
    for constants in product(*((item.value, *item.start_values) for item in effect.constants)):
        for size in effect.start_values or (effect.typical,):
            start = values.copy()
            start[first : first + 1 + len(constants)] = size, *constants
            result.append(start)
    return result


def _shifts(names: Sequence[str], uncertain: Mapping[str, float]) -> list[Array]:
    """Shifts of the uncertain parameters in starts: none, and all by a standard deviation."""
    sds = np.array([uncertain.get(name, 0.0) for name in names])
    return [sign * sds for sign in (0.0, -1.0, 1.0)[: 3 if uncertain else 1]]


def _as_result(
    search: Search, fits: Sequence[LastingFit], model: ProcessModel, uncertain: Mapping[str, float]
) -> LastingResult:
    """Hypotheses of lasting causes without process noise, about the uncertain parameters of the first."""
    run, best = search.run, fits[0]
    about = model.with_values({name: best.values[name] for name in uncertain})
    constant, noise = Constant(run.time_min), _sensor_noise(best.error_sd.tolist(), about)
    items = []
    for fit in fits:
        profiles = (constant,) * len(fit.effects)
        hypothesis = Hypothesis(FaultFilter(about, fit.effects, noise, run.period_min), profiles)
        start = [np.array([fit.values[name] for name in _names(effect)]) for effect in fit.effects]
        fitted = hypothesis.evaluate(run, start) if fit is best else hypothesis.fit(run, start)
        items.append(search.score_fit(hypothesis, fitted))
    nominal = Hypothesis(FaultFilter(about, (), noise, run.period_min), ())
    without = search.score_fit(nominal, nominal.evaluate(run, ()))
    ordered = [items[0], *sorted(items[1:], key=lambda item: item.bic)]
    sds = {name: best.sds[name] for name in uncertain}
    return LastingResult(SearchResult(noise, noise, without, ordered), sds)


def _sensor_noise(sd: Sequence[float], model: ProcessModel) -> Noise:
    """Noise levels without process noise."""
    return Noise(tuple(sd), (0.0,) * len(model.states))


def _rms(errors: Array) -> Array:
    """Root mean square error of each output; infinite where the simulation diverged."""
    return np.nan_to_num(rms(errors), nan=np.inf, posinf=np.inf)
