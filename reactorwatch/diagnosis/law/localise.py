"""Location of an unknown, by laws and by a free curve in time, and its comparison with the catalogue.

Where no function of states and inputs explains the record, something wanders in time: then the free curves of
`unknown_input` are compared as well.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import log

import numpy as np
from numpy.typing import NDArray

from reactorwatch.diagnosis.fitting.fault_filter import FilterEvaluation, huber_loss
from reactorwatch.diagnosis.fitting.hypothesis import Fit
from reactorwatch.diagnosis.law.unknown import (
    FittedLaw,
    StartedPlaces,
    Unknown,
    find_laws,
    fit_places,
    start_places,
)
from reactorwatch.diagnosis.result import LISTED
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis, SearchResult
from reactorwatch.diagnosis.unknown_input.localise import UnknownInput, locate
from reactorwatch.diagnosis.whiteness import DOUBTFUL, WHITE
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

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
        if self.curve is not None:
            return {self.curve.effect.location: 0.0}
        return {name: worse for name, worse in self.found.locations.items() if worse < LISTED}

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
