"""Find where an unknown acts, and its law.

A smooth correction in each place is fitted inside the simulation (`shapes`, `fit`), first with the process noise of the
nominal filter, which keeps the fit near the record, then without. Where the best correction leaves a coloured residual,
noise levels are estimated under it, process noise too; then the nearest places are fitted again. In the best places
formulas are sought (`formula`). A location's evidence is the best BIC of its corrections and formulas.

The location is compared with the catalogue, by laws and by a free curve in time. Where no function of
states and inputs explains the record, something wanders in time: then the free curves of `unknown_input` are compared
as well.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import log

import msgspec
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.colored_noise import Noise, estimate_sensor_noise
from reactorwatch.diagnosis.fitting.fault_filter import HUBER, FilterEvaluation, huber_loss
from reactorwatch.diagnosis.fitting.hypothesis import Fit
from reactorwatch.diagnosis.law.fit import ShapeFit, ShapeFitter
from reactorwatch.diagnosis.law.formula import FormulaSearch, law_shape
from reactorwatch.diagnosis.law.shapes import (
    Answers,
    Scale,
    Shape,
    find_answers,
    make_shape,
    scales_along,
    variables_along,
)
from reactorwatch.diagnosis.result import LISTED
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis, SearchResult
from reactorwatch.diagnosis.unknown_input.localise import UnknownInput, locate
from reactorwatch.diagnosis.whiteness import DOUBTFUL, WHITE, minus_log10_p
from reactorwatch.process.effect import Effect
from reactorwatch.process.law import ExtendedLaw, places_of
from reactorwatch.process.model import Place, ProcessModel
from reactorwatch.progress import report_stage, track

FIRST_STEPS, STEPS = 2, 6
"""Gauss-Newton steps with the nominal filter's process noise, and without: with 4, one law in ten stops too early."""

NEAR = 60.0
"""Threshold in BIC: formulas are sought in places that are worse than the best by less."""

NEAREST = 2
"""Number of places in which formulas are sought."""

PROMISING = 4
"""Number of places that are fitted without process noise, at least."""

SMALLEST_SHARE = 0.5
"""Smallest noise of a sensor, as a fraction of the estimate from its highest frequencies."""

FAR = 1000.0
"""Threshold in BIC: places that are worse by more are not fitted again with other noise levels."""

FORMULAS = 4
"""Forms that are fitted inside the simulation."""

WORTH = 15.0
"""Threshold in BIC: forms whose prediction is worse than the best by more are not fitted."""


@dataclass(frozen=True, eq=False)
class FittedLaw:
    """A law fitted inside the simulation.

    Attributes:
        law: the law with fitted parameters.
        fit: fit of its parameters.
        log_p: largest minus decimal logarithm of the p-value that its innovations are white.
    """

    law: ExtendedLaw
    fit: ShapeFit
    log_p: float

    @property
    def place(self) -> Place:
        """Place of the law."""
        return self.fit.place

    @property
    def bic(self) -> float:
        """BIC of the fit."""
        return self.fit.bic

    def noise_sd(self, model: ProcessModel) -> Array:
        """Standard deviation of each sensor's noise, shape (n_y,)."""
        return self.fit.noise.sensor_sd(model.output_names)


@dataclass(frozen=True, eq=False)
class Unknown:
    """Evidence about an unknown.

    Attributes:
        places: smooth corrections, the best first.
        laws: laws, the best first; empty: no formula comes near the smooth correction.
        noise: noise levels of all of them.
        log_p: largest minus decimal logarithm of the p-value that the innovations of the best one are white.
    """

    places: tuple[ShapeFit, ...]
    laws: tuple[FittedLaw, ...]
    noise: Noise
    log_p: float

    @property
    def bic(self) -> float:
        """BIC of the best correction or law."""
        return min([self.places[0].bic, *(law.bic for law in self.laws)])

    @property
    def locations(self) -> dict[str, float]:
        """BIC of each location over that of the best, the best first."""
        result: dict[str, float] = {}
        found: tuple[ShapeFit | FittedLaw, ...] = (*self.places, *self.laws)
        for item in found:
            location = item.place.location
            result[location] = min(item.bic - self.bic, result.get(location, np.inf))
        return dict(sorted(result.items(), key=lambda item: item[1]))


@dataclass(frozen=True, eq=False)
class StartedPlaces:
    """Smooth corrections fitted with the sensors' noise alone.

    Attributes:
        fits: corrections, the best first.
        apart: places of corrections with a part in another place, not yet fitted.
        scales: scales of the variables.
        answers: inputs that answer to measurements.
        free: noise levels of the fits.
        wide: noise levels of their first steps.
    """

    fits: list[ShapeFit]
    apart: list[Place]
    scales: Mapping[str, Scale]
    answers: Answers
    free: Noise
    wide: Noise

    @property
    def misfit(self) -> float:
        """Mean square of the best correction's normalised innovations."""
        return float(np.nanmean(np.square(self.fits[0].evaluation.w)))


def start_places(model: ProcessModel, run: Run, nominal: Fit, noise: Noise) -> StartedPlaces:
    """Fit smooth corrections in all places of a process, with the sensors' noise alone.

    Args:
        model: process model of the plant.
        run: the record.
        nominal: fit without any cause.
        noise: noise levels of its filter.
    """
    declared = places_of(model)
    places = [place for place in declared if not any(place.name == item.apart for item in declared)]
    scales = scales_along(model, run, nominal.innovations.x, declared)
    residual = nominal.innovations.residual
    sensor_sd = estimate_sensor_noise(noise, model.output_names, residual, run.measured, run.period_min)
    own = len(model.states)  # states of uncertain parameters follow
    wide = Noise(tuple(sensor_sd.tolist()), noise.process_sd[:own], noise.colored)
    free = Noise(wide.measurement_sd, (0.0,) * own, noise.colored)
    alone, apart = ([place for place in places if bool(place.apart) is flag] for flag in (False, True))
    nominals: dict[tuple[str, ...], FilterEvaluation] = {}
    answers = find_answers(model, run)
    started = [
        _start(make_shape(model, place, scales, answers), run, wide, nominals)
        for place in track("looking for an unknown, place", alone)
    ]
    return StartedPlaces(_fit_all(started, free), apart, scales, answers, free, wide)


def fit_places(model: ProcessModel, run: Run, started: StartedPlaces) -> Unknown:
    """Fit the best smooth corrections with the noise levels that are likely under them.

    Args:
        model: process model of the plant.
        run: the record.
        started: corrections with the sensors' noise alone.
    """
    fits, wide, free = list(started.fits), started.wide, started.free
    if _log_p(fits[0], run) >= DOUBTFUL or any(item.location == fits[0].place.location for item in started.apart):
        shapes = [make_shape(model, place, started.scales, started.answers) for place in started.apart]
        fits += _fit_all([_start(shape, run, wide, {}) for shape in shapes], free)
        fits.sort(key=_bic)
    levels = _likely_noise(model, run, fits[0], free, wide)
    fits = sorted((_refit(item, levels) for item in fits if item.bic < fits[0].bic + FAR), key=_bic)
    return Unknown(tuple(fits), (), levels, _log_p(fits[0], run))


def find_laws(model: ProcessModel, run: Run, found: Unknown) -> Unknown:
    """Fit laws in the best places."""
    laws: list[FittedLaw] = []
    for item in track("looking for a law, place", found.places[:NEAREST]):
        if item.bic < found.places[0].bic + NEAR:
            laws += _find_laws(model, item, run, found.noise)
    if not laws:
        return found
    laws.sort(key=_bic)
    best = min(found.places[0], laws[0].fit, key=_bic)
    return replace(found, laws=tuple(laws), log_p=_log_p(best, run))


def _likely_noise(model: ProcessModel, run: Run, best: ShapeFit, free: Noise, wide: Noise) -> Noise:
    """Noise levels under the best correction or, if that has a kink between two hinges, under a law.

    Process noise is estimated only where the residual calls for it.
    """
    fits = [best]
    if _log_p(best, run) >= DOUBTFUL:
        fits += [law.fit for law in _find_laws(model, best, run, free)[:1]]
    fit = min(fits, key=_bic)
    if _log_p(fit, run) < DOUBTFUL:
        rms = np.sqrt(np.nanmean(np.square(np.clip(fit.evaluation.w, -HUBER, HUBER)), axis=0))
        return Noise(tuple((np.array(free.measurement_sd) * rms).tolist()), free.process_sd, free.colored)
    smallest = [SMALLEST_SHARE * item for item in wide.measurement_sd]
    found = best.fitter.estimate_noise(best, wide, smallest)
    # The states that a correction adds, such as that of a lag, are its own; other corrections do not have them.
    return Noise(found.measurement_sd, found.process_sd[: len(model.states)], found.colored)


def _start(shape: Shape, run: Run, wide: Noise, nominals: dict[tuple[str, ...], FilterEvaluation]) -> ShapeFit:
    """First steps of a fit, with process noise; without any correction all filters with the same states are equal."""
    fitter, zero, states = ShapeFitter(shape, run, wide), np.zeros(len(shape.parameters)), shape.model.state_names
    if states not in nominals:
        nominals[states] = fitter.evaluate(zero).evaluation
    return fitter.fit(zero, wide, FIRST_STEPS, first=nominals[states])


def _fit_all(started: Sequence[ShapeFit], free: Noise) -> list[ShapeFit]:
    """Fits without process noise of the most promising places, the best first."""
    started = sorted(started, key=_bic)
    near = [item for i, item in enumerate(started) if i < PROMISING or item.bic < started[0].bic + NEAR]
    return sorted((_refit(item, free) for item in track("fitting an unknown, place", near)), key=_bic)


def _refit(item: ShapeFit, noise: Noise) -> ShapeFit:
    return item.fitter.fit(item.coefficients, noise, STEPS)


def _bic(item: ShapeFit | FittedLaw) -> float:
    return item.bic


def _log_p(fit: ShapeFit, run: Run) -> float:
    return float(np.max(minus_log10_p(fit.evaluation.w, run.inputs)))


def _find_laws(model: ProcessModel, smooth: ShapeFit, run: Run, noise: Noise) -> list[FittedLaw]:
    """Best forms in the place of a smooth correction, fitted inside the simulation."""
    variables = variables_along(model, run, smooth.evaluation.innovations.x, smooth.place, smooth.lag_min)
    candidates = FormulaSearch(smooth, smooth.fitter.dynamics(smooth), run, variables).candidates()
    result = []
    for bic, law in candidates[:FORMULAS]:
        if bic > candidates[0][0] + WORTH:
            break
        fitter = ShapeFitter(law_shape(model, smooth.place, law), run, noise)
        fit = fitter.fit(np.zeros(len(law.parameters)), noise, STEPS, select=False)
        moved = zip(law.parameters.items(), fit.coefficients.tolist(), strict=True)
        law = msgspec.structs.replace(law, parameters={name: value + by for (name, value), by in moved})
        result.append(FittedLaw(law, fit, _log_p(fit, run)))
    return sorted(result, key=_bic)


CURVE_MARGIN, LAW_MARGIN = 25.0, 10.0
"""Thresholds in BIC over the best of the catalogue: a free curve is more flexible than a law."""

SIMPLE = 3
"""Largest number of parameters of a law that stands beside a pair of causes."""

MISFIT = 1.6
"""Mean square of the normalised innovations of the best smooth correction: beyond it pairs are searched before laws.
Beside a law with a kink it is 1.2."""

HOPELESS = 0.25
"""BIC a value by which smooth corrections may be worse than an explanation with a white residual before laws are
sought: a law with a kink explains more than they do."""

NOISY_SHARE = 0.003
"""Fraction of a state's scale per square root of a minute: with more process noise a law may not be complete."""


@dataclass(frozen=True, eq=False)
class Localised:
    """Location of an unknown.

    Attributes:
        found: corrections and laws.
        curve: free curve in time, where it explains the record better; else None.
    """

    found: Unknown
    curve: UnknownInput | None

    @property
    def law(self) -> FittedLaw | None:
        """Best law, if it leaves a white residual; else None."""
        if self.curve is not None or not self.found.laws or self.found.laws[0].log_p >= WHITE:
            return None
        return self.found.laws[0]

    @property
    def approximation(self) -> float:
        """BIC of the best law over that of the smooth correction; negative if it explains more."""
        return self.found.laws[0].bic - self.found.places[0].bic if self.found.laws else np.inf

    @property
    def locations(self) -> dict[str, float]:
        """BIC of each location within `LISTED` over that of the best, the best first."""
        found = self.found.locations if self.curve is None else self.curve.locations
        return {name: worse for name, worse in found.items() if worse < LISTED}

    @property
    def location(self) -> str:
        """Best location."""
        return next(iter(self.locations))

    def gain_over(self, best: FittedHypothesis) -> float:
        """BIC of a hypothesis of the catalogue over that of the unknown."""
        if self.curve is not None:
            return _bic_on(best, self.curve.used) - self.curve.bic
        return best.bic - self.found.bic

    def is_better(self, best: FittedHypothesis) -> bool:
        """Return true if the unknown explains the run clearly better than a hypothesis of the catalogue."""
        return self.gain_over(best) > (LAW_MARGIN if self.curve is None else CURVE_MARGIN)


class UnknownSearch:
    """Search of one run for an unknown; its parts are computed when they are asked for.

    Args:
        model: process model without uncertain parameters.
        effects: the catalogue.
        run: the record.
        result: search of the catalogue.
    """

    def __init__(self, model: ProcessModel, effects: Sequence[Effect], run: Run, result: SearchResult) -> None:
        self._effects, self._run, self._nominal, self._noise = effects, run, result.nominal, result.nominal_noise
        offsets = self._nominal.hypothesis.offsets(self._nominal.fit)
        self._model = model.with_values({name: model.parameter(name).value + by for name, by in offsets.items()})

    @property
    def is_simple(self) -> bool:
        """True if a law with few parameters explains all of the run, so that a pair of causes cannot be much better."""
        if self._first_places.misfit > MISFIT or not self._evidence.laws:
            return False
        law = self._evidence.laws[0]
        return (
            law.log_p < DOUBTFUL
            and len(law.law.parameters) <= SIMPLE
            and law.bic < self._evidence.places[0].bic + LISTED
        )

    def localise(self, explained_bic: float = np.inf) -> Localised:
        """Localise the unknown.

        Args:
            explained_bic: BIC of a hypothesis of the catalogue that leaves a white residual without much process noise,
                which a free curve in time cannot improve; infinite: there is none.
        """
        limit = explained_bic + HOPELESS * self._run.values
        if self._first_places.fits[0].bic > limit:
            return Localised(Unknown(tuple(self._first_places.fits), (), self._first_places.free, np.inf), None)
        found, curve = self._evidence, None
        if np.isinf(explained_bic) and (found.log_p >= WHITE or _is_noisy(found, self._model)):
            report_stage("looking for an unknown course in time")
            curve = locate(self._model, self._effects, self._run, self._nominal.fit, self._noise)
            if curve is not None:
                count = np.count_nonzero(found.places[0].coefficients)
                of_law = _evaluate_on(found.places[0].evaluation, curve.used) + count * log(self._run.values)
                curve = curve if curve.bic < of_law - CURVE_MARGIN else None
        return Localised(found, curve)

    @cached_property
    def _first_places(self) -> StartedPlaces:
        return start_places(self._model, self._run, self._nominal.fit, self._noise)

    @cached_property
    def _evidence(self) -> Unknown:
        return find_laws(self._model, self._run, fit_places(self._model, self._run, self._first_places))


def _is_noisy(found: Unknown, model: ProcessModel) -> bool:
    shares = (sd / state.scale for sd, state in zip(found.noise.process_sd, model.states, strict=False))
    return max(shares) > NOISY_SHARE


def _bic_on(fitted: FittedHypothesis, used: NDArray[np.bool_]) -> float:
    """BIC of a hypothesis of the catalogue, by some of the values alone."""
    return _evaluate_on(fitted.fit, used) - 2.0 * fitted.fit.loss + fitted.bic


def _evaluate_on(evaluation: FilterEvaluation | Fit, used: NDArray[np.bool_]) -> float:
    """Twice the loss of some of the values."""
    w, sd = evaluation.w, evaluation.innovations.conditional_sd
    counted = used & np.isfinite(w) & np.isfinite(sd)
    logs = float(np.sum(np.log(np.where(counted, sd, 1.0))))
    return 2.0 * (huber_loss(np.where(counted, w, 0.0)) + logs)
