"""Score a diagnosis against the truth."""

from dataclasses import dataclass, field
from math import exp, inf, nan

import numpy as np

from reactorwatch.diagnosis.result import Cause, Diagnosis
from tests.hidden_effect.courses import HiddenCourse
from tests.hidden_effect.draw import Hidden

WIDTH = 1.959964
"""Standard deviations to either side of a 95 % interval."""

NOMINAL, UNKNOWN = "nominal", "unknown"


@dataclass(frozen=True)
class Judged:
    """One record: what was hidden, what was said, and how far that is off.

    Attributes:
        seed: of the record.
        truth: names of what is hidden, sorted; empty: nothing.
        courses: their kinds.
        sizes: their sizes.
        strength: see `Hidden`.
        verdict: of the diagnosis.
        said: names of the causes, sorted.
        profiles: their profiles.
        alternatives: names of the causes of every other explanation, each sorted, joined by +.
        location: that was said.
        first: whether exactly what is hidden was named.
        listed: whether it was named or is among the alternatives; of nothing hidden, whether nothing was found.
        count: explanations on the list.
        size_errors: relative, of each cause that is right and has the right profile, other than a free curve.
        size_inside: whether its 95 % interval holds the size.
        size_scores: its error in its standard deviations.
        curve_errors: of each cause that is right, root mean square of what its curve is off by, over that of the truth.
        onset_errors: in min, of each right step.
        onset_inside: whether its 95 % interval holds the onset.
        onset_scores: its error in its standard deviations.
        probability: probability of the explanation that was given, among all that were listed.
        right_place: whether the location is right.
        held_out: error of T on rows not seen, in true standard deviations of its noise.
        drawn: what that of the truth itself would be: the noise that was drawn in those rows, likewise.
        before: the same of the nominal model.
        seconds: of a core that it took.
        remark: what went wrong, if the diagnosis did not come to an end.
    """

    seed: int
    truth: tuple[str, ...]
    courses: tuple[str, ...]
    sizes: tuple[float, ...]
    strength: float
    verdict: str = ""
    said: tuple[str, ...] = ()
    profiles: tuple[str, ...] = ()
    alternatives: tuple[str, ...] = ()
    location: str = ""
    first: bool = False
    listed: bool = False
    count: int = 0
    size_errors: tuple[float, ...] = ()
    size_inside: tuple[bool, ...] = ()
    curve_errors: tuple[float, ...] = ()
    onset_errors: tuple[float, ...] = ()
    onset_inside: tuple[bool, ...] = ()
    right_place: bool = False
    held_out: float = nan
    drawn: float = nan
    before: float = nan
    seconds: float = nan
    remark: str = field(default="")
    size_scores: tuple[float, ...] = ()
    onset_scores: tuple[float, ...] = ()
    probability: float = nan

    @property
    def called(self) -> str:
        """What it was called, in a word or two."""
        if self.remark:
            return "error"
        return "+".join(self.said) if self.said and self.verdict != UNKNOWN else self.verdict

    @property
    def wrong(self) -> bool:
        """Whether something was claimed that is not there: a cause, or that the simulation is wrong when it is not."""
        return self.verdict != NOMINAL if not self.truth else self.called not in ("+".join(self.truth), NOMINAL)


def failed(hidden: Hidden, remark: str, seconds: float) -> Judged:
    """A diagnosis that raised an error."""
    return Judged(*_truth(hidden), seconds=seconds, remark=remark)


def judge(hidden: Hidden, said: Diagnosis, seconds: float) -> Judged:
    """A diagnosis beside the truth."""
    causes = () if said.verdict in (NOMINAL, UNKNOWN) else said.causes
    named = tuple(sorted(item.cause for item in causes))
    others = [tuple(sorted(cause for cause, _ in item.causes)) for item in said.alternatives]
    first = named == hidden.causes and (bool(named) or said.verdict == NOMINAL)
    kinds = {effect.name: course for effect, course in zip(hidden.effects, hidden.courses, strict=True)}
    right = [(item, kinds[item.cause]) for item in causes if item.cause in kinds and first]
    alike = [pair for pair in right if pair[0].profile == pair[1].kind and pair[1].kind != "free"]
    steps = [pair for pair in alike if pair[1].kind == "step"]
    places = {place for effect in hidden.effects for place in effect.places}
    held_out = said.gain.held_out["T"]
    noise_sd = hidden.circumstances.noise_sd[1]
    return Judged(
        *_truth(hidden),
        verdict=said.verdict,
        said=named,
        profiles=tuple(item.profile for item in sorted(causes, key=lambda item: item.cause)),
        alternatives=tuple("+".join(item) for item in others),
        location=said.location or "",
        first=first,
        listed=first or (bool(hidden.causes) and hidden.causes in others),
        count=1 + len(said.alternatives),
        size_errors=tuple(_off(item, course) / abs(course.size) for item, course in alike),
        size_inside=tuple(_off(item, course) <= WIDTH * item.parameters["size"].sd for item, course in alike),
        curve_errors=tuple(_curve_error(item, course, said) for item, course in right),
        onset_errors=tuple(abs(item.parameters["onset"].value - course.onset_min) for item, course in steps),
        onset_inside=tuple(
            abs(item.parameters["onset"].value - course.onset_min) <= WIDTH * item.parameters["onset"].sd
            for item, course in steps
        ),
        right_place=said.location in places if places else said.location == "",
        held_out=held_out.rmse_after / noise_sd,
        drawn=_drawn(hidden, said) / noise_sd,
        before=held_out.rmse_before / noise_sd,
        seconds=seconds,
        size_scores=tuple(_off(item, course) / max(item.parameters["size"].sd, 1e-300) for item, course in alike),
        onset_scores=tuple(
            abs(item.parameters["onset"].value - course.onset_min) / max(item.parameters["onset"].sd, 1e-300)
            for item, course in steps
        ),
        probability=1.0 / (1.0 + sum(exp(-0.5 * item.delta_bic) for item in said.alternatives)),
    )


def _truth(hidden: Hidden) -> tuple[int, tuple[str, ...], tuple[str, ...], tuple[float, ...], float]:
    sorted_by_name = sorted(zip(hidden.effects, hidden.courses, strict=True), key=lambda pair: pair[0].name)
    kinds, sizes = (
        tuple(course.kind for _, course in sorted_by_name),
        tuple(course.size for _, course in sorted_by_name),
    )
    return hidden.seed, hidden.causes, kinds, sizes, hidden.strength


def _off(cause: Cause, course: HiddenCourse) -> float:
    return abs(cause.parameters["size"].value - course.size)


def _drawn(hidden: Hidden, said: Diagnosis) -> float:
    """Root mean square of the noise of T in the rows not seen."""
    if said.curves is None:
        return nan
    noise = (hidden.record.columns["T"] - hidden.shown[:, 1])[said.curves.held_out["T"]]
    return float(np.sqrt(np.mean(noise**2))) if noise.size else nan


def _curve_error(cause: Cause, course: HiddenCourse, said: Diagnosis) -> float:
    if said.curves is None:
        return nan
    truth = course.at(said.curves.time_min)
    size = float(np.sqrt(np.mean(truth**2)))
    return float(np.sqrt(np.mean((said.curves.deviation[cause.cause] - truth) ** 2))) / size if size else inf
