"""The search for the hypothesis that explains a run best, and for its rivals.

How noisy the process is decides how much a filter forgives its model, and to a model that lacks something the process
seems noisy. So noise and hypothesis are found in turn: leads are looked for about the nominal model with the noise that
it needs, the best are fitted, the noise that the best of these needs is found, and about its run, where little is
forgiven, leads are looked for again. All hypotheses are compared by the BIC (Schwarz 1978, Estimating the dimension of
a model, Annals of Statistics 6) with the noise of the best.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import log
from typing import TypeAlias

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import grid_search, onset_refinement
from reactorwatch.diagnosis.fitting.colored_noise import Noise, suspected
from reactorwatch.diagnosis.fitting.fault_filter import Followed, Sized
from reactorwatch.diagnosis.fitting.hypothesis import MOST_STEPS, Fit, Hypothesis
from reactorwatch.diagnosis.fitting.knot_selection import best_resolved, fine
from reactorwatch.diagnosis.fitting.outliers import gross_outliers, outliers, without
from reactorwatch.diagnosis.fitting.profiles import Free, Signal
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.dynamic_effects_screen import MemoryScreen
from reactorwatch.diagnosis.search.screen import Lead, Screen
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

FIRST_LEADS, MOST_LEADS, LEADS, A_CAUSE = 3, 8, 10, 2
"""How many leads of the first screen are fitted, and if none of them gains anything; of each later one; of a cause."""

FIRST_SCORE, SCAN_SCORE = 4.0, 30.0
"""What a lead of the first screen has to promise in BIC; chance alone seldom promises so much. And one of an effect
that acts in jumps, whose fit is a scan, and costs as much as ten others."""

LEAST_SCORE = -20.0
"""A rival that promises less in BIC is not fitted."""

IN_QUESTION, FAR_OUT = 100.0, 600.0
"""In BIC: a rival that is worse by more is out of question; and with any other noise too. A free curve with twelve
knots that needs but three costs ninety too much."""

ROUGH = 1e-3
"""Share of what a lead promises by which it is out, at least: the equations are not linear."""

LEAST_SENSOR_GAIN = 10.0
"""In BIC: less does not make a sensor's noise remember."""

ROUNDS = 5

SETTLED_NOISE = 10.0
"""In BIC: a noise that gains less is not worth another round."""

NOISES = 3
"""Near so many that were found last the next one is sought; with the first rows', as many as go in lanes."""

_NEAR = 4.0
_SMALLER = 0.3  # of what the linear size is
_SHARE = 0.3  # of what the best lead promises: linear promises of memory are rough


Key: TypeAlias = tuple[tuple[str, str], ...]
"""(cause, profile) of each effect."""


@dataclass(frozen=True, eq=False)
class Explained:
    """A hypothesis that has been fitted.

    Attributes:
        hypothesis: the effects and their kinds of course.
        fit: of it.
        bic: of the fit.
    """

    hypothesis: Hypothesis
    fit: Fit
    bic: float

    @property
    def key(self) -> Key:
        """(cause, profile) of its effects, in the order of their names."""
        courses = (course.name for course in self.hypothesis.courses)
        return tuple(sorted(zip(self.hypothesis.causes, courses, strict=True)))


@dataclass(frozen=True, eq=False)
class Found:
    """What a search found.

    Attributes:
        noise: of the plant and its sensors, under the best hypothesis; the same sensors' noise remembers under all.
        own_noise: likewise, under the nominal one.
        nominal: the one without any effect, with the noise that it needs itself; its key is empty.
        explained: all that were fitted, the best first.
        remembering: leads among effects with memory.
    """

    noise: Noise
    own_noise: Noise
    nominal: Explained
    explained: list[Explained]
    remembering: tuple[Lead, ...] = ()

    @property
    def best(self) -> Explained:
        """The one with the least BIC."""
        return min([self.nominal, *self.explained], key=lambda item: item.bic)


class Search:
    """Searches one run.

    Args:
        model: of the plant.
        effects: the catalogue.
        run: the record.
        smallest_sd: of the sensors, one an output.

    Attributes:
        run: the record without its outliers.
        noise: that all hypotheses are compared with.
        screen: of the run.
    """

    def __init__(self, model: ProcessModel, effects: Sequence[Effect], run: Run, smallest_sd: Sequence[float]) -> None:
        self._model, self._smallest_sd = model, list(smallest_sd)
        self.run = without(run, gross_outliers(run.measured))
        self._sized: dict[tuple[str, ...], Sized] = {}
        self._nothing: tuple[Noise, float] | None = None
        self._settled: list[Noise] = []  # taken last
        self._period_min = float(np.median(np.diff(run.time_min)))
        self.noise = self._first_noise()
        self.screen = Screen(model, effects, self.run)
        self.memory = MemoryScreen(self.screen.with_memory, self.run)

    def found(self) -> Found:
        """The best explanations by one effect."""
        nominal, own_noise = self.nominal(), self.noise
        remembering = self._sorted(self.memory.leads(nominal.fit, self._followed, least_score=FIRST_SCORE))
        leads = self._sorted(self.screen.leads(nominal.hypothesis, nominal.fit) + remembering)
        best, known = nominal, dict[Key, Explained]()
        worth = [lead for lead in leads if lead.score(self.run.values) > _least_score(lead)]
        for number, lead in enumerate(_of_different_causes(worth)):
            if number >= (MOST_LEADS if best is nominal else FIRST_LEADS):
                break
            item = self.fitted(lead)
            known[item.key] = item
            best = min(best, item, key=lambda item: item.bic)
        least = max([LEAST_SCORE, *(_SHARE * item.score(self.run.values) for item in leads[:1])])
        remembering = self.chosen(remembering, LEADS, least, of_a_cause=1)
        known = self._in_rounds(best, known, remembering)
        return Found(self.noise, own_noise, nominal, _in_order(known), tuple(remembering))

    def about(self, best: Explained, found: Found) -> Found:
        """What is found once it is known how noisy the process is under a better explanation."""
        known = self._in_rounds(best, {best.key: best}, found.remembering)
        return Found(self.noise, found.own_noise, found.nominal, _in_order(known), found.remembering)

    def _in_rounds(
        self, best: Explained, known: dict[Key, Explained], remembering: Sequence[Lead]
    ) -> dict[Key, Explained]:
        """Noise and hypothesis in turn; all that were fitted with the noise of the best."""
        searched: Explained | None = None
        out = set[Key]()
        for _ in range(ROUNDS):
            if not best.key or (best is searched and not self._settled_anew(best)):
                break
            if best is not searched:
                self.settle(best)
            known = {item.key: self.refitted(item) for item in known.values() if item.bic < best.bic + IN_QUESTION}
            known = {key: self.resolved(item) for key, item in known.items()}
            best = searched = known[best.key]
            leads = self.screen.leads(best.hypothesis, best.fit, replaced=(0,))
            least = max([LEAST_SCORE, *(self._still_in_question(item) for item in leads[:1])])
            beside = [lead for lead in [*self._simpler(leads, best), *remembering] if _key(lead) not in out]
            for lead in [*self.chosen(leads, LEADS, least), *beside]:
                fresh = _key(lead) not in known or (_key(lead) == best.key and self._elsewhere(lead, best))
                if fresh:
                    item = self.fitted(lead)
                    keep(known, self.resolved(item) if item.bic < best.bic + IN_QUESTION else item)
                    out |= {item.key} if item.bic > best.bic + FAR_OUT else set()
            best = min(known.values(), key=lambda item: item.bic)
        return known

    def _first_noise(self) -> Noise:
        """Under which the nominal model is likeliest. Its free run tells which values are outliers."""
        nominal = self._sized[()] = Sized(self._model, (), self._still((1.0,) * len(self._model.outputs)))
        noise = nominal.tuned(self.run, (), self._smallest_sd)
        nominal.noise = self._still(noise.measurement_sd)
        self.run = without(self.run, outliers(self.run.measured, nominal.follow(self.run, ()).found.residual))
        return noise

    def _still(self, measurement_sd: tuple[float, ...]) -> Noise:
        """Without any that moves the process: the filter runs freely."""
        return Noise(measurement_sd, (0.0,) * len(self._model.states))

    def remembers(self, best: Explained) -> bool:
        """Whether the noise of a sensor remembers, by what the best explanation leaves; from then on it does.

        Only an explanation that is right tells: what a model lacks would be taken for noise that remembers for long.
        """
        sized, signals, noise = best.hypothesis.sized, best.hypothesis.signals(best.fit), self.noise
        sized.noise = self._still(noise.measurement_sd)
        left = sized.follow(self.run, signals).found.residual
        self._use_noise(sized)
        wandering = suspected(noise, self._model.output_names, left, self._period_min)
        if not wandering:
            return False
        beside = Sized(
            self._model, sized.effects, Noise(noise.measurement_sd, noise.process_sd, wandering), self._period_min
        )
        beside.noise = beside.tuned(self.run, signals, self._smallest_sd)
        gain = 2.0 * (sized.follow(self.run, signals).loss - beside.follow(self.run, signals).loss)
        if gain < LEAST_SENSOR_GAIN + 2 * len(wandering) * log(self.run.values):
            return False
        nominal = Sized(self._model, (), beside.noise, self._period_min)
        self._sized = {(): nominal}
        self.noise = nominal.noise = nominal.tuned(self.run, (), self._smallest_sd)
        return True

    def nominal(self) -> Explained:
        """Without any effect."""
        found = self.explained(Hypothesis(self.sized(()), ()), ())
        self._nothing = (self.noise, found.fit.loss)
        return found

    def settle(self, best: Explained) -> None:
        """Take the noise that a hypothesis needs for that of all."""
        signals = best.hypothesis.signals(best.fit)
        self.noise = best.hypothesis.sized.tuned(self.run, signals, self._smallest_sd, self._beside(self.noise))
        self._settled = self._beside(self.noise)

    def _beside(self, noise: Noise) -> list[Noise]:
        """A noise, and others that were taken last."""
        return [noise, *(item for item in self._settled if item != noise)][:NOISES]

    def _settled_anew(self, best: Explained) -> bool:
        """Whether another noise goes with its numbers than with the rougher ones it was found with; then it holds."""
        held, sized = self.noise, best.hypothesis.sized
        self.settle(best)
        self._use_noise(sized)
        if self.explained(best.hypothesis, best.fit.theta).bic < best.bic - SETTLED_NOISE:
            return True
        self.noise = held
        self._use_noise(sized)
        return False

    def chosen(self, leads: Sequence[Lead], count: int, least: float, of_a_cause: int = A_CAUSE) -> list[Lead]:
        """The best leads that promise enough, not too many of one cause."""
        found: list[Lead] = []
        for lead in leads:
            same = [item for item in found if item.effect is lead.effect]
            new = all(item.course.name != lead.course.name for item in same)
            if new and len(same) < of_a_cause and lead.score(self.run.values) > least:
                found.append(lead)
            if len(found) == count:
                break
        return found

    def _followed(self, effect: Effect, signals: Sequence[Signal]) -> list[Followed]:
        return self.sized((effect,)).follow_all(self.run, [[signal] for signal in signals])

    @cached_property
    def _grid(self) -> Free:
        return fine(self.run.time_min)

    def resolved(self, item: Explained, steps: int = MOST_STEPS) -> Explained:
        """With as many knots as its free curves need."""
        hypothesis = item.hypothesis
        for place, course in enumerate(hypothesis.courses):
            if not isinstance(course, Free) or place == hypothesis.sized.late:
                continue
            courses, theta = list(item.hypothesis.courses), list(item.fit.theta)
            courses[place], theta[place] = best_resolved(self._grid, self.run, item.hypothesis, item.fit, place)
            if courses[place].coefficients != course.coefficients:
                other = self.fit(Hypothesis(hypothesis.sized, courses), theta, steps, scan=False)
                item = min(item, other, key=lambda item: item.bic)
        return item

    def _sorted(self, leads: Sequence[Lead]) -> list[Lead]:
        return sorted(leads, key=lambda item: -item.score(self.run.values))

    def _simpler(self, leads: Sequence[Lead], best: Explained) -> list[Lead]:
        """The best's own cause in every simpler course: with the right one, it needs fewer numbers."""
        (effect,), (course,) = best.hypothesis.sized.effects, best.hypothesis.courses
        of_cause = [item for item in leads if item.effect is effect and item.course.freedom < course.freedom]
        names = dict.fromkeys(item.course.name for item in of_cause)
        return [next(item for item in of_cause if item.course.name == name) for name in names]

    def fitted(self, lead: Lead) -> Explained:
        """A lead as a hypothesis. Where the linear size leads astray, it is fitted from a smaller one."""
        hypothesis = Hypothesis(self.sized((lead.effect,)), (lead.course,))
        found = self.fit(hypothesis, (lead.theta,))
        if lead.effect.is_discontinuous or found.fit.loss < self._loss_of_nothing():
            return found
        shares = np.where(np.arange(lead.theta.size) < lead.course.coefficients, _SMALLER, 1.0)
        return min(found, self.fit(hypothesis, (shares * lead.theta,)), key=lambda item: item.bic)

    def _still_in_question(self, first: Lead) -> float:
        """What a lead has to promise beside the first; the more is promised, the rougher it is."""
        score = first.score(self.run.values)
        return score - max(IN_QUESTION, ROUGH * score)

    def _loss_of_nothing(self) -> float:
        """Of the nominal model with the noise that holds now."""
        if self._nothing is None or self._nothing[0] is not self.noise:
            return self.nominal().fit.loss
        return self._nothing[1]

    def fit(
        self, hypothesis: Hypothesis, start: Sequence[Array], steps: int = MOST_STEPS, scan: bool = True
    ) -> Explained:
        """Fit a hypothesis from a start, by `grid_search` where its sizes act in jumps and `scan` is set."""
        best = (
            grid_search.fitted(self.run, hypothesis, start, steps) if scan else hypothesis.fit(self.run, start, steps)
        )
        return self.judged(hypothesis, onset_refinement.walked(self.run, hypothesis, best, steps))

    def _elsewhere(self, lead: Lead, best: Explained) -> bool:
        """Whether a lead of the best's own cause and course begins where its fit is not."""
        if not lead.course.numbers:
            return False
        theta = best.fit.theta[0]
        apart = np.abs(lead.theta - theta)[lead.course.coefficients :]
        return bool(np.any(apart > _NEAR * lead.course.least_differences))

    def refitted(self, explained: Explained, scan: bool = False) -> Explained:
        """With the noise that holds now; sizes that act in jumps stay, unless they are looked for anew."""
        self._use_noise(explained.hypothesis.sized)
        return self.fit(explained.hypothesis, explained.fit.theta, scan=scan)

    def explained(self, hypothesis: Hypothesis, theta: Sequence[Array]) -> Explained:
        """A hypothesis at some numbers."""
        return self.judged(hypothesis, hypothesis.at(self.run, theta))

    def sized(self, effects: tuple[Effect, ...]) -> Sized:
        """The model with these effects, made once."""
        names = tuple(effect.name for effect in effects)
        if names not in self._sized:
            self._sized[names] = Sized(self._model, effects, self.noise, self._period_min)
        self._use_noise(self._sized[names])
        return self._sized[names]

    def _use_noise(self, sized: Sized) -> None:
        sized.noise = self.noise

    def judged(self, hypothesis: Hypothesis, fit: Fit) -> Explained:
        """A hypothesis at a fit of it that is there already."""
        return Explained(hypothesis, fit, 2.0 * fit.loss + hypothesis.freedom * log(self.run.values))


def keep(known: dict[Key, Explained], item: Explained) -> None:
    """Put a fit among those that are known, unless a better one of the same effects and courses is."""
    if item.key not in known or item.bic < known[item.key].bic:
        known[item.key] = item


def _in_order(known: dict[Key, Explained]) -> list[Explained]:
    return sorted(known.values(), key=lambda item: item.bic)


def _of_different_causes(leads: Sequence[Lead]) -> list[Lead]:
    """The first of each cause."""
    found: dict[str, Lead] = {}
    for lead in leads:
        found.setdefault(lead.effect.name, lead)
    return list(found.values())


def _least_score(lead: Lead) -> float:
    return SCAN_SCORE if lead.effect.is_discontinuous else FIRST_SCORE


def _key(lead: Lead) -> Key:
    return ((lead.effect.name, lead.course.name),)
