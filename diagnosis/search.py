"""The search for the hypothesis that explains a run best, and for its rivals.

How noisy the process is decides how much a filter forgives its model, and to a model that lacks something the process
seems noisy. So noise and hypothesis are found in turn: leads are looked for about the nominal model with the noise that
it needs, the best are fitted, the noise that the best of these needs is found, and about its run, where little is
forgiven, leads are looked for again. All hypotheses are compared by the BIC (Schwarz 1978, Estimating the dimension of
a model, Annals of Statistics 6) with the noise of the best.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

from diagnosis.hypothesis import Fit, Hypothesis, Sized
from diagnosis.run import Run
from diagnosis.screen import Lead, Screen
from reactorwatch.process.effects.base import Effect
from reactorwatch.process.filter import NoiseLevels
from reactorwatch.process.model import Array, ProcessModel
from reactorwatch.process.noise import tune

FIRST_LEADS, SECOND_LEADS, A_CAUSE = 6, 10, 2
"""How many leads are fitted of the first and of the second screen, and how many of a cause."""

LEAST_SCORE = -20.0
"""A lead that promises less in BIC is not fitted."""

FIRST_STEPS = 4
IN_QUESTION = 60.0
"""In BIC: what is worse than the best by more is not fitted on."""


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
    def key(self) -> tuple[tuple[str, str], ...]:
        """(cause, profile) of its effects, in the order of their names."""
        courses = (course.name for course in self.hypothesis.courses)
        return tuple(sorted(zip(self.hypothesis.causes, courses, strict=True)))


@dataclass(frozen=True, eq=False)
class Found:
    """What a search found.

    Attributes:
        noise: of the plant and its sensors, under the best hypothesis.
        nominal: the one without any effect, with that noise; its key is empty.
        explained: all that were fitted, the best first.
    """

    noise: NoiseLevels
    nominal: Explained
    explained: list[Explained]

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
    """

    def __init__(self, model: ProcessModel, effects: Sequence[Effect], run: Run, smallest_sd: Sequence[float]) -> None:
        self._model, self.run, self._smallest_sd = model, run, list(smallest_sd)
        self.screen = Screen(model, effects, run)
        self._sized: dict[tuple[str, ...], Sized] = {}
        self.noise = tune(model, run.time_min, run.inputs, run.measured, self._smallest_sd)

    def found(self) -> Found:
        """The best explanations by one effect."""
        nominal = self.nominal()
        leads = self.screen.leads(nominal.hypothesis.sized, nominal.fit)
        fitted = [self.fitted(item, FIRST_STEPS) for item in self.chosen(leads, FIRST_LEADS)]
        best = min([nominal, *fitted], key=lambda item: item.bic)
        if best is nominal:
            return Found(self.noise, nominal, _sorted(fitted))
        known = {item.key: item for item in fitted}
        for _ in range(3):
            self.settle(best)
            leads = self.screen.leads(best.hypothesis, best.fit)
            for item in self.chosen(leads, SECOND_LEADS):
                known.setdefault(_key(item), self.fitted(item, 0))
            refitted = self.refitted(list(known.values()))
            known = {item.key: item for item in refitted}
            again, best = best, min(refitted, key=lambda item: item.bic)
            if best.key == again.key:
                break
        return Found(self.noise, self.nominal(), _sorted(list(known.values())))

    def nominal(self) -> Explained:
        """Without any effect."""
        return self.explained(Hypothesis(self.sized(()), ()), ())

    def settle(self, best: Explained) -> None:
        """Take the noise that a hypothesis needs for that of all."""
        sized, run = best.hypothesis.sized, self.run
        inputs = sized.inputs(run, best.hypothesis.signals(best.fit))
        found = tune(sized.model, run.time_min, inputs, run.measured, self._smallest_sd)
        self.noise = NoiseLevels(found.measurement_sd, found.process_sd[: len(self._model.states)])

    def chosen(self, leads: Sequence[Lead], count: int) -> list[Lead]:
        """The best leads, not too many of one cause."""
        found: list[Lead] = []
        for lead in leads:
            same = [item for item in found if item.effect is lead.effect]
            new = all(item.course.name != lead.course.name for item in same)
            if new and len(same) < A_CAUSE and lead.score(self.run.values) > LEAST_SCORE:
                found.append(lead)
            if len(found) == count:
                break
        return found

    def fitted(self, lead: Lead, steps: int) -> Explained:
        """A lead as a hypothesis, fitted by so many steps."""
        hypothesis = Hypothesis(self.sized((lead.effect,)), (lead.course,))
        fit = hypothesis.fit(self.run, (lead.theta,), steps)
        return self._with_bic(hypothesis, fit)

    def refitted(self, explained: Sequence[Explained]) -> list[Explained]:
        """With the noise that holds now, those in question to the end."""
        found = []
        for item in explained:
            self._use_noise(item.hypothesis.sized)
            found.append(self._with_bic(item.hypothesis, item.hypothesis.fit(self.run, item.fit.theta, FIRST_STEPS)))
        best = min(item.bic for item in found)
        return [
            self._with_bic(item.hypothesis, item.hypothesis.fit(self.run, item.fit.theta))
            if item.bic < best + IN_QUESTION
            else item
            for item in found
        ]

    def explained(self, hypothesis: Hypothesis, theta: Sequence[Array]) -> Explained:
        """A hypothesis at some numbers."""
        return self._with_bic(hypothesis, hypothesis.at(self.run, theta))

    def sized(self, effects: tuple[Effect, ...]) -> Sized:
        """The model with these effects, made once."""
        names = tuple(effect.name for effect in effects)
        if names not in self._sized:
            self._sized[names] = Sized(self._model, effects, self.noise)
        self._use_noise(self._sized[names])
        return self._sized[names]

    def _use_noise(self, sized: Sized) -> None:
        sized.noise = self.noise

    def _with_bic(self, hypothesis: Hypothesis, fit: Fit) -> Explained:
        return Explained(hypothesis, fit, 2.0 * fit.loss + hypothesis.freedom * log(self.run.values))


def _key(lead: Lead) -> tuple[tuple[str, str], ...]:
    return ((lead.effect.name, lead.course.name),)


def _sorted(explained: list[Explained]) -> list[Explained]:
    return sorted(explained, key=lambda item: item.bic)
