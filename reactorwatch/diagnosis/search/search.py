"""Search for the hypothesis that explains a run best, and for its alternatives.

Process noise decides how much model error a filter tolerates, and an incomplete model has large process noise. So noise
levels and hypothesis are estimated in turn: screen about the nominal model with its own noise levels, fit the best
candidates, estimate the noise levels of the best fit, and screen again about its run, where little is tolerated. All
hypotheses are compared by the BIC (Schwarz 1978, Estimating the dimension of a model, Annals of Statistics 6) with the
noise levels of the best.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import log
from typing import TypeAlias

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.colored_noise import Noise, detect_colored_noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter, FilterEvaluation
from reactorwatch.diagnosis.fitting.hypothesis import MOST_STEPS, Fit, Hypothesis, prior_cost
from reactorwatch.diagnosis.fitting.outliers import find_gross_outliers, find_outliers, remove_outliers
from reactorwatch.diagnosis.fitting.profiles import LateSine, PiecewiseLinear, Signal, Sine
from reactorwatch.diagnosis.fitting.scan import GRID, refine_onset, select_knots
from reactorwatch.diagnosis.fitting.scan import fit_hypothesis as scan_and_fit
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.dynamic_and_pair_screens import DynamicEffectsScreen
from reactorwatch.diagnosis.search.screen import Candidate, Part, Screen, first_of_each
from reactorwatch.kalman.noise_estimation import resolution_sd
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.progress import report_stage, track

FIRST_CANDIDATES, MOST_CANDIDATES, CANDIDATES, A_CAUSE = 3, 8, 10, 2
"""Candidates of the first screen that are fitted, and if none of them gains anything; of later screens; of one
cause."""

FIRST_SCORE, SCAN_SCORE = 4.0, 30.0
"""Minimum predicted gain in BIC in the first screen, which chance alone seldom reaches; and that of a discontinuous
effect, whose fit is a scan and costs as much as ten others."""

LEAST_SCORE = -20.0
"""Minimum predicted gain in BIC of an alternative."""

IN_QUESTION, FAR_OUT = 100.0, 600.0
"""Thresholds in BIC: alternatives that are worse by more than the first are dropped, by more than the second at any
other noise levels, too. A curve with twelve knots that needs only three costs ninety too much."""

FIRST_MARGIN = 0.05
"""Share of the best's gain in BIC within which the candidates of the first screen are fitted again: with the nominal
model's process noise a cause with constants of its own may be better than the right one."""

ROUGH = 1e-3
"""Minimum error of a predicted gain, as a fraction of it: the equations are not linear."""

SMALLEST_NOISE = 1e-3
"""Lower bound of a sensor's noise as a fraction of the state's scale; files have so many digits."""

LEAST_SENSOR_GAIN = 10.0
"""Minimum gain in BIC of coloured sensor noise."""

ROUNDS = 5

SINE_ONSETS = 24
"""Onsets that are tried for a sine."""

CONVERGED_NOISE = 10.0
"""Threshold in BIC: noise levels that gain less are not worth another round."""

NOISES = 3
"""Recent noise levels that the next estimate starts from; with the first rows', they fill the lanes."""

_NEAR = 4.0
_SMALLER = 0.3  # fraction of the linear size
_SHARE = 0.3  # fraction of the best prediction; those of dynamic effects are rough


Label: TypeAlias = tuple[tuple[str, str], ...]
"""(cause, profile) of each effect."""


@dataclass(frozen=True, eq=False)
class FittedHypothesis:
    """A fitted hypothesis.

    Attributes:
        hypothesis: the effects and their kinds of profile.
        fit: fit of the hypothesis.
        bic: BIC of the fit.
    """

    hypothesis: Hypothesis
    fit: Fit
    bic: float

    @property
    def parts(self) -> list[Part]:
        """Each effect with its profile and parameters."""
        parts = zip(self.hypothesis.filter.effects, self.hypothesis.profiles, self.fit.parameters, strict=True)
        return [Part(*item) for item in parts]

    @property
    def label(self) -> Label:
        """(cause, profile) of its effects, in the order of their names."""
        return tuple(sorted(part.label for part in self.parts))


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of a search.

    Attributes:
        noise: noise levels under the best hypothesis; the same sensors have coloured noise under all hypotheses.
        nominal_noise: noise levels under the nominal hypothesis.
        nominal: hypothesis without any effect, at its own noise levels; its label is empty.
        hypotheses: all fitted hypotheses, the best first.
        dynamic_candidates: candidates among the effects with internal states.
    """

    noise: Noise
    nominal_noise: Noise
    nominal: FittedHypothesis
    hypotheses: list[FittedHypothesis]
    dynamic_candidates: tuple[Candidate, ...] = ()

    @property
    def best(self) -> FittedHypothesis:
        """Hypothesis with the lowest BIC."""
        return min([self.nominal, *self.hypotheses], key=lambda item: item.bic)


class Search:
    """Search of one run.

    Args:
        model: process model of the plant.
        effects: the catalogue.
        run: the record.
        smallest_sd: lower bound of each sensor's noise.

    Attributes:
        run: the record without its outliers.
        noise: noise levels with which all hypotheses are compared.
        screen: screen of the run.
        noise_effects: effects that change the noise of a sensor, which the screen leaves out.
    """

    def __init__(self, model: ProcessModel, effects: Sequence[Effect], run: Run, smallest_sd: Sequence[float]) -> None:
        self._model, self._smallest_sd = model, list(smallest_sd)
        self.run = remove_outliers(run, find_gross_outliers(run.measured))
        self._filters: dict[tuple[str, ...], FaultFilter] = {}
        self._nominal_loss: tuple[Noise, float] | None = None
        self._recent: list[Noise] = []  # the latest first
        self.noise = self._initial_noise()
        self.screen = Screen(model, [effect for effect in effects if not effect.is_noise], self.run)
        self.noise_effects = tuple(effect for effect in effects if effect.is_noise)
        self.dynamic_screen = DynamicEffectsScreen(self.screen.dynamic_effects, self.run)
        self._n_causes = len(effects)

    def search_single_causes(self) -> SearchResult:
        """Find the best hypotheses with one effect."""
        nominal, nominal_noise = self.fit_nominal(), self.noise
        dynamic = self.dynamic_screen.candidates(nominal.fit, self._evaluate_with, least_score=FIRST_SCORE)
        dynamic_candidates = self._sort(dynamic)
        candidates = self._sort(self.screen.candidates(nominal.hypothesis, nominal.fit) + dynamic_candidates)
        best, by_label = nominal, dict[Label, FittedHypothesis]()
        worth = [
            item
            for item in candidates
            if item.score(self.run.values) > (SCAN_SCORE if item.effect.is_discontinuous else FIRST_SCORE)
        ]
        to_fit = first_of_each(worth, lambda item: item.effect.name)
        for number, candidate in enumerate(to_fit):
            most = MOST_CANDIDATES if best is nominal else FIRST_CANDIDATES
            if number >= most:
                break
            report_stage("fitting cause", number + 1, min(most, len(to_fit)))
            item = self.fit_candidate(candidate)
            by_label[item.label] = item
            best = min(best, item, key=lambda item: item.bic)
        least = max([LEAST_SCORE, *(_SHARE * item.score(self.run.values) for item in candidates[:1])])
        dynamic_candidates = self.select(dynamic_candidates, CANDIDATES, least, of_a_cause=1)
        margin = max(IN_QUESTION, FIRST_MARGIN * (nominal.bic - best.bic))
        by_label = self._alternate(best, by_label, dynamic_candidates, margin)
        return SearchResult(self.noise, nominal_noise, nominal, _in_order(by_label), tuple(dynamic_candidates))

    def search_from(self, best: FittedHypothesis, result: SearchResult) -> SearchResult:
        """Search again with the noise levels of a better hypothesis."""
        by_label = self._alternate(best, {best.label: best}, result.dynamic_candidates)
        return SearchResult(
            self.noise, result.nominal_noise, result.nominal, _in_order(by_label), result.dynamic_candidates
        )

    def _alternate(
        self,
        best: FittedHypothesis,
        by_label: dict[Label, FittedHypothesis],
        dynamic_candidates: Sequence[Candidate],
        margin: float = IN_QUESTION,
    ) -> dict[Label, FittedHypothesis]:
        """Estimate noise levels and search in turn; returns all that were fitted with the noise levels of the best.

        At first those are fitted again that are worse by less than the margin.
        """
        searched: FittedHypothesis | None = None
        dropped = set[Label]()
        for _ in range(ROUNDS):
            if not best.label or (best is searched and not self._update_if_better(best)):
                break
            if best is not searched:
                self.update_noise(best)
            by_label = {item.label: self.refit(item) for item in by_label.values() if item.bic < best.bic + margin}
            margin = IN_QUESTION
            by_label = {key: self.with_selected_knots(item) for key, item in by_label.items()}
            best = searched = by_label[best.label]
            candidates = self.screen.candidates(best.hypothesis, best.fit, replaced=(0,))
            least = max([LEAST_SCORE, *(self._least_score_beside(item) for item in candidates[:1])])
            extended = [*self._simpler_profiles(candidates, best), *dynamic_candidates]
            extended = [item for item in extended if (item.label,) not in dropped]
            for candidate in track("fitting cause", [*self.select(candidates, CANDIDATES, least), *extended]):
                label: Label = (candidate.label,)
                if label not in by_label or (label == best.label and self._is_distant(candidate, best)):
                    item = self.fit_candidate(candidate)
                    keep_best(by_label, self.with_selected_knots(item) if item.bic < best.bic + IN_QUESTION else item)
                    dropped |= {item.label} if item.bic > best.bic + FAR_OUT else set()
            best = min(by_label.values(), key=lambda item: item.bic)
        return by_label

    def _initial_noise(self) -> Noise:
        """Noise levels under which the nominal model is most likely. Its simulation shows the outliers."""
        report_stage("estimating the noise")
        noise = self._without_process_noise((1.0,) * len(self._model.outputs))
        nominal = self._filters[()] = FaultFilter(self._model, (), noise)
        noise = nominal.estimate_noise(self.run, (), self._smallest_sd)
        nominal.noise = self._without_process_noise(noise.measurement_sd)
        residual = nominal.evaluate(self.run, ()).innovations.residual
        self.run = remove_outliers(self.run, find_outliers(self.run.measured, residual))
        return noise

    def _without_process_noise(self, measurement_sd: tuple[float, ...]) -> Noise:
        """Noise levels without process noise, with which the filter is a simulation."""
        return Noise(measurement_sd, (0.0,) * len(self._model.states))

    def adopt_colored_noise(self, best: FittedHypothesis) -> bool:
        """Adopt coloured sensor noise if the residual of the best hypothesis calls for it; return true if so.

        This needs the right hypothesis: model error would be taken for noise with a long time constant.
        """
        ekf, signals, noise = best.hypothesis.filter, best.hypothesis.signals(best.fit), self.noise
        ekf.noise = self._without_process_noise(noise.measurement_sd)
        residual = ekf.evaluate(self.run, signals).innovations.residual
        self._use_noise(ekf)
        colored = detect_colored_noise(noise, self._model.output_names, residual, self.run.period_min)
        if not colored:
            return False
        noise = Noise(noise.measurement_sd, noise.process_sd, colored)
        extended = FaultFilter(self._model, ekf.effects, noise, self.run.period_min)
        extended.noise = extended.estimate_noise(self.run, signals, self._smallest_sd)
        gain = 2.0 * (ekf.evaluate(self.run, signals).loss - extended.evaluate(self.run, signals).loss)
        if gain < LEAST_SENSOR_GAIN + 2 * len(colored) * log(self.run.values):
            return False
        nominal = FaultFilter(self._model, (), extended.noise, self.run.period_min)
        self._filters = {(): nominal}
        self.noise = nominal.noise = nominal.estimate_noise(self.run, (), self._smallest_sd)
        return True

    def fit_nominal(self) -> FittedHypothesis:
        """Evaluate the hypothesis without any effect."""
        result = self.evaluate(Hypothesis(self.filter(()), ()), ())
        self._nominal_loss = (self.noise, result.fit.loss)
        return result

    def update_noise(self, best: FittedHypothesis) -> None:
        """Adopt the noise levels that are most likely under a hypothesis."""
        signals = best.hypothesis.signals(best.fit)
        nearby = self._recent_noises(self.noise)
        self.noise = best.hypothesis.filter.estimate_noise(self.run, signals, self._smallest_sd, nearby)
        self._recent = self._recent_noises(self.noise)

    def _recent_noises(self, noise: Noise) -> list[Noise]:
        """These noise levels, and others that were adopted last."""
        return [noise, *(item for item in self._recent if item != noise)][:NOISES]

    def _update_if_better(self, best: FittedHypothesis) -> bool:
        """Adopt the noise levels of the best hypothesis's present parameters if they gain enough; return true if so."""
        noise, ekf = self.noise, best.hypothesis.filter
        self.update_noise(best)
        self._use_noise(ekf)
        if self.evaluate(best.hypothesis, best.fit.parameters).bic < best.bic - CONVERGED_NOISE:
            return True
        self.noise = noise
        self._use_noise(ekf)
        return False

    def select(
        self, candidates: Sequence[Candidate], count: int, least: float, of_a_cause: int = A_CAUSE
    ) -> list[Candidate]:
        """Select the best candidates that predict enough, not too many of one cause."""
        result: list[Candidate] = []
        for candidate in candidates:
            same = [item for item in result if item.effect is candidate.effect]
            new = all(item.profile.name != candidate.profile.name for item in same)
            if new and len(same) < of_a_cause and candidate.score(self.run.values) > least:
                result.append(candidate)
            if len(result) == count:
                break
        return result

    def _evaluate_with(self, effect: Effect, signals: Sequence[Signal]) -> list[FilterEvaluation]:
        return self.filter((effect,)).evaluate_all(self.run, [[signal] for signal in signals])

    @cached_property
    def _grid(self) -> PiecewiseLinear:
        return PiecewiseLinear(self.run.time_min, GRID)

    def with_selected_knots(self, item: FittedHypothesis, steps: int = MOST_STEPS) -> FittedHypothesis:
        """Refit piecewise-linear profiles with the number of knots that they need, and sines that set in later."""
        hypothesis = item.hypothesis
        for index, profile in enumerate(hypothesis.profiles):
            if not isinstance(profile, PiecewiseLinear) or index == hypothesis.filter.delay_index:
                continue
            profiles, parameters = list(item.hypothesis.profiles), list(item.fit.parameters)
            profiles[index], parameters[index] = select_knots(self._grid, self.run, item.hypothesis, item.fit, index)
            if profiles[index].n_linear != profile.n_linear:
                other = self.fit(Hypothesis(hypothesis.filter, profiles), parameters, steps, scan=False)
                item = min(item, other, key=lambda item: item.bic)
        return self._with_late_sines(item, steps)

    def _with_late_sines(self, item: FittedHypothesis, steps: int) -> FittedHypothesis:
        """Refit sines with an onset, where they gain by setting in later."""
        for index, profile in enumerate(item.hypothesis.profiles):
            if type(profile) is not Sine:
                continue
            late, profiles = LateSine(self.run.time_min), list(item.hypothesis.profiles)
            profiles[index] = late
            hypothesis = Hypothesis(item.hypothesis.filter, profiles)
            onsets = late.start_min + self.run.span_min * np.linspace(0.0, 0.9, SINE_ONSETS + 1)[1:]
            tried = [late.from_sine(item.fit.parameters[index], onset) for onset in onsets.tolist()]
            first = min(hypothesis.evaluate_values(self.run, item.fit, index, tried), key=lambda fit: fit.loss)
            if first.loss < item.fit.loss:
                item = min(item, self.fit(hypothesis, first.parameters, steps, scan=False), key=lambda each: each.bic)
        return item

    def _sort(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        return sorted(candidates, key=lambda item: -item.score(self.run.values))

    def _simpler_profiles(self, candidates: Sequence[Candidate], best: FittedHypothesis) -> list[Candidate]:
        """The best hypothesis's own cause with every simpler profile: the right one needs fewer parameters."""
        (effect,), (profile,) = best.hypothesis.filter.effects, best.hypothesis.profiles
        most = profile.n_parameters - 1
        of_cause = [item for item in candidates if item.effect is effect and item.profile.n_parameters <= most]
        names = dict.fromkeys(item.profile.name for item in of_cause)
        return [next(item for item in of_cause if item.profile.name == name) for name in names]

    def fit_candidate(self, candidate: Candidate) -> FittedHypothesis:
        """Fit a candidate; also from a smaller magnitude if the linear one gains nothing."""
        hypothesis = Hypothesis(self.filter((candidate.effect,)), (candidate.profile,))
        result = self.fit(hypothesis, (candidate.parameters,))
        if candidate.effect.is_discontinuous or result.fit.loss < self._loss_of_nominal():
            return result
        shares = np.where(np.arange(candidate.parameters.size) < candidate.profile.n_linear, _SMALLER, 1.0)
        return min(result, self.fit(hypothesis, (shares * candidate.parameters,)), key=lambda item: item.bic)

    def _least_score_beside(self, first: Candidate) -> float:
        """Predicted gain that a candidate needs beside the first; large predictions are less accurate."""
        score = first.score(self.run.values)
        return score - max(IN_QUESTION, ROUGH * score)

    def _loss_of_nominal(self) -> float:
        """Loss of the nominal model at the present noise levels."""
        if self._nominal_loss is None or self._nominal_loss[0] is not self.noise:
            return self.fit_nominal().fit.loss
        return self._nominal_loss[1]

    def fit(
        self, hypothesis: Hypothesis, start: Sequence[Array], steps: int = MOST_STEPS, scan: bool = True
    ) -> FittedHypothesis:
        """Fit a hypothesis, by `fitting.scan` where its effects are discontinuous and `scan` is set."""
        best = scan_and_fit(self.run, hypothesis, start, steps) if scan else hypothesis.fit(self.run, start, steps)
        return self.score_fit(hypothesis, refine_onset(self.run, hypothesis, best, steps))

    def _is_distant(self, candidate: Candidate, best: FittedHypothesis) -> bool:
        """Return true if a candidate with the best's cause and profile starts far from its fit."""
        if not candidate.profile.nonlinear_parameters:
            return False
        shape = slice(candidate.profile.n_linear, candidate.profile.n_shape)
        apart = np.abs(candidate.parameters[shape] - best.fit.parameters[0][shape])
        return bool(np.any(apart > _NEAR * candidate.profile.difference_steps))

    def refit(self, fitted: FittedHypothesis) -> FittedHypothesis:
        """Fit again at the present noise levels; magnitudes of discontinuous effects stay."""
        self._use_noise(fitted.hypothesis.filter)
        return self.fit(fitted.hypothesis, fitted.fit.parameters, scan=False)

    def evaluate(self, hypothesis: Hypothesis, parameters: Sequence[Array]) -> FittedHypothesis:
        """Evaluate a hypothesis at given parameters."""
        return self.score_fit(hypothesis, hypothesis.evaluate(self.run, parameters))

    def filter(self, effects: tuple[Effect, ...]) -> FaultFilter:
        """Filter of the model with these effects, created once."""
        names = tuple(effect.name for effect in effects)
        if names not in self._filters:
            self._filters[names] = FaultFilter(self._model, effects, self.noise, self.run.period_min)
        self._use_noise(self._filters[names])
        return self._filters[names]

    def _use_noise(self, ekf: FaultFilter) -> None:
        ekf.noise = self.noise

    def score_fit(self, hypothesis: Hypothesis, fit: Fit) -> FittedHypothesis:
        """BIC of an existing fit."""
        charged = hypothesis.n_parameters - len(hypothesis.constant_indices)
        bic = 2.0 * fit.loss + charged * log(self.run.values) + hypothesis.constants_evidence(self.run, fit)
        return FittedHypothesis(hypothesis, fit, bic + prior_cost(hypothesis, self._n_causes))


def keep_best(by_label: dict[Label, FittedHypothesis], item: FittedHypothesis) -> None:
    """Add a fit, unless there is a better one of the same effects and profiles."""
    if item.label not in by_label or item.bic < by_label[item.label].bic:
        by_label[item.label] = item


def _in_order(by_label: dict[Label, FittedHypothesis]) -> list[FittedHypothesis]:
    return sorted(by_label.values(), key=lambda item: item.bic)


def smallest_noise(model: ProcessModel, measured: Array) -> list[float]:
    """Lower bound of each sensor's noise: at least that of the resolution of its values, shape (rows, n_y)."""
    scales = {state.name: state.scale for state in model.states}
    return [
        max(SMALLEST_NOISE * scales.get(output.name, 1.0), resolution_sd(column))
        for output, column in zip(model.outputs, measured.T, strict=True)
    ]
