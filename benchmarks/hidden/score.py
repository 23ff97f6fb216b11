"""Numbers of a class of records, from what was judged record by record."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isnan, nan, sqrt

import numpy as np

from tests.hidden_effect.judge import NOMINAL, UNKNOWN, WIDTH, Judged


class Share(float):
    """A share with the number of which it is one, so that its interval is known."""

    count: int

    @classmethod
    def of(cls, found: Iterable[bool]) -> "Share":
        """Share of the true ones; NaN of none."""
        values = [float(item) for item in found]
        result = cls(np.mean(values) if values else nan)
        result.count = len(values)
        return result

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval (Wilson 1927, J. American Statistical Association 22)."""
        n, z = self.count, WIDTH
        middle = (self + z * z / (2.0 * n)) / (1.0 + z * z / n)
        half = z / (1.0 + z * z / n) * sqrt(self * (1.0 - self) / n + z * z / (4.0 * n * n))
        return max(middle - half, 0.0), min(middle + half, 1.0)


@dataclass(frozen=True)
class Score:
    """Scores of some records; shares from 0 to 1, NaN without a denominator."""

    records: int  # number of records
    first: float  # share in which exactly the hidden causes are named
    listed: float  # share in which they are named or listed
    count: float  # mean number of listed explanations
    wrong: float  # share with a false claim
    unknown: float  # share called unknown
    unknown_in_place: float  # share called unknown with the right location
    right_place: float  # share with the right location, whatever the name
    same_profile: float  # share of the right causes with the right profile
    size: tuple[float, float]  # median and 90 % quantile of the relative error of the size
    curve: tuple[float, float]  # median and 90 % quantile of the relative error of the curve
    size_inside: float  # share of the 95 % intervals that contain the size
    onset: tuple[float, float]  # median and 90 % quantile of the error of a step's onset, in min
    onset_inside: float  # share of the 95 % intervals that contain the onset
    held_out: tuple[float, float]
    held_out_in_sd: tuple[float, float]  # error of T on held-out rows over the standard deviation of the noise
    drawn_in_sd: tuple[float, float]  # error of the truth on held-out rows over the standard deviation of the noise
    before: tuple[float, float]  # error of the nominal model over the standard deviation of the noise, as `held_out`
    seconds: tuple[float, float]  # median and maximum of the core seconds
    errors: int  # number of diagnoses that failed

    @classmethod
    def of(cls, judged: Sequence[Judged]) -> "Score":
        """The score of some records."""
        ended = [item for item in judged if not item.remark]
        right = [(course, profile) for item in judged if item.first for course, profile in _courses(item)]
        return cls(
            records=len(judged),
            first=Share.of(item.first for item in judged),
            listed=Share.of(item.listed for item in judged),
            count=_mean([item.count for item in ended]),
            wrong=Share.of(item.wrong for item in judged),
            unknown=Share.of(item.verdict == UNKNOWN for item in judged),
            unknown_in_place=Share.of(item.verdict == UNKNOWN and item.right_place for item in judged),
            right_place=Share.of(item.right_place for item in judged),
            same_profile=Share.of(course == profile for course, profile in right),
            size=_two([error for item in judged for error in item.size_errors], 0.9),
            curve=_two([error for item in judged for error in item.curve_errors], 0.9),
            size_inside=Share.of(inside for item in judged for inside in item.size_inside),
            onset=_two([error for item in judged for error in item.onset_errors], 0.9),
            onset_inside=Share.of(inside for item in judged for inside in item.onset_inside),
            held_out=_two([item.held_out / item.drawn for item in ended if not isnan(item.drawn)], 0.9),
            held_out_in_sd=_two([item.held_out for item in ended], 0.9),
            drawn_in_sd=_two([item.drawn for item in ended if not isnan(item.drawn)], 0.9),
            before=_two([item.before for item in ended], 0.9),
            seconds=_two([item.seconds for item in judged], 1.0),
            errors=sum(bool(item.remark) for item in judged),
        )


def confusion(judged: Sequence[Judged]) -> list[tuple[str, list[tuple[str, int]]]]:
    """Names given to each truth, the most frequent first."""
    called: dict[str, Counter[str]] = {}
    for item in judged:
        called.setdefault("+".join(item.truth) or NOMINAL, Counter())[item.called] += 1
    return [(truth, counts.most_common()) for truth, counts in called.items()]


def _courses(item: Judged) -> Iterable[tuple[str, str]]:
    return zip(item.courses, item.profiles, strict=True)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else nan


def _two(values: Sequence[float], share: float) -> tuple[float, float]:
    """The median and another quantile; what is not a number counts as infinite."""
    if not values:
        return nan, nan
    sorted_up = np.sort(np.where(np.isfinite(values), values, np.inf))
    places = [max(int(np.ceil(item * sorted_up.size)) - 1, 0) for item in (0.5, share)]
    return float(sorted_up[places[0]]), float(sorted_up[places[1]])
