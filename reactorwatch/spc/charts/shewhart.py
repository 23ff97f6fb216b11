"""The Shewhart chart of individual values, with run rules.

Shewhart (1931), Economic Control of Quality of Manufactured Product. A point beyond mean +- L sigma is out. By itself
the rule has no memory, so it sees a large change at once and a small one late. The run rules of the Western
Electric Handbook (1956) look at the last points too. Numbered as by Champ & Woodall (1987), Exact results for Shewhart
control charts with supplementary runs rules, Technometrics 29(4), table 1, for the usual L = 3:

    1   one point beyond 3 sigma
    2   two of the last three beyond 2 sigma, on one side
    3   four of the last five beyond 1 sigma, on one side
    4   eight in a row on one side

For another L the inner lines stay at thirds of it. A point is out when it completes a pattern, so it is one of
those that the pattern counts; "two of three" may fire after two points. For independent normal values a point is out
by rule 1 by chance with the probability 2 (1 - Phi(L)), 0.0027 at L = 3: every 370th. All four rules
together: every 92nd (`run_length.shewhart`).

The memory: how many points in a row were on one side (negative below, no more than 8), and the zones of the last
four, counted in thirds of L from the mean.
"""

from collections.abc import Iterable
from math import erfc, sqrt
from typing import Self

import numpy as np
from scipy import special

from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import positive
from reactorwatch.spc import false_alarm_budget
from reactorwatch.spc.baseline import Baseline
from reactorwatch.spc.charts.base import Array, Judgement, Shown, finite
from reactorwatch.spc.compiled_chart import PRESENT, SETTINGS, CompiledChart, X, write_point
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.run_length.shewhart import RULES, checked_rules

_MEMORIES = 5
_MEAN, _THIRD, _LOWER, _UPPER, _RULE1, _RULE2, _RULE3, _RULE4, _START = range(SETTINGS, SETTINGS + 9)
_RUN, _ZONE1, _ZONE2, _ZONE3, _ZONE4, _END = range(_START + _MEMORIES, _START + _MEMORIES + 6)


@jit
def _judge(columns: Array) -> None:
    for p in range(columns.shape[1]):
        present = columns[PRESENT, p] > 0.0
        x, mean, third = columns[X, p], columns[_MEAN, p], columns[_THIRD, p]
        lower, upper = columns[_LOWER, p], columns[_UPPER, p]
        run = columns[_RUN, p]
        zone1, zone2, zone3, zone4 = columns[_ZONE1, p], columns[_ZONE2, p], columns[_ZONE3, p], columns[_ZONE4, p]

        off = x - mean
        side = 1.0 if off > 0.0 else (-1.0 if off < 0.0 else 0.0)
        size = abs(off)
        inner = 2.0 if size > 2.0 * third else (1.0 if size > third else 0.0)
        zone = 3.0 if (x > upper) | (x < lower) else inner
        longer = run + side if run * side > 0.0 else side
        longer = min(max(longer, -8.0), 8.0)
        # How many of the points before are beyond the lines on this point's side.
        beyond2 = (1.0 if side * zone1 >= 2.0 else 0.0) + (1.0 if side * zone2 >= 2.0 else 0.0)
        beyond1 = (1.0 if side * zone1 >= 1.0 else 0.0) + (1.0 if side * zone2 >= 1.0 else 0.0)
        beyond1 += (1.0 if side * zone3 >= 1.0 else 0.0) + (1.0 if side * zone4 >= 1.0 else 0.0)

        out = columns[_RULE1, p] if zone >= 3.0 else 0.0
        out += columns[_RULE2, p] if (zone >= 2.0) & (beyond2 >= 1.0) else 0.0
        out += columns[_RULE3, p] if (zone >= 1.0) & (beyond1 >= 3.0) else 0.0
        out += columns[_RULE4, p] if abs(longer) >= 8.0 else 0.0

        columns[_RUN, p] = longer if present else run
        columns[_ZONE1, p] = side * zone if present else zone1
        columns[_ZONE2, p] = zone1 if present else zone2
        columns[_ZONE3, p] = zone2 if present else zone3
        columns[_ZONE4, p] = zone3 if present else zone4
        write_point(columns, p, x, mean, lower, upper, out)


class Shewhart(CompiledChart):
    """Individual values against mean +- L sigma, and against run rules.

    >>> chart = Shewhart(mean=0.0, sigma=1.0, rules=(1, 2))
    >>> [chart.update(x).out for x in (2.5, 0.0, 2.1, 3.5)]
    [False, False, True, True]

    Args:
        mean: mean of the values when all is well.
        sigma: standard deviation of the values when all is well.
        width: L, in sigma.
        rules: some of 1, 2, 3, 4.

    Raises:
        InputError: sigma or width is not a positive number, or there is no such rule.
    """

    name = "shewhart"
    has_memory = False
    memories = _MEMORIES
    numbers = _END - SETTINGS
    kernel = staticmethod(_judge)

    def __init__(self, mean: float, sigma: float, width: float = 3.0, rules: Iterable[int] = (1,)) -> None:
        positive("sigma", sigma)
        positive("width", width)
        wanted = checked_rules(rules)
        lower, upper = finite(mean) - width * sigma, mean + width * sigma
        flags = [1.0 if rule in wanted else 0.0 for rule in RULES]
        super().__init__([mean, width * sigma / 3.0, lower, upper, *flags], np.zeros(_MEMORIES).tolist())

    @classmethod
    def design(cls, baseline: Baseline) -> Self:
        """See `SignalChart`; without run rules."""
        (learned,) = baseline.learned
        return cls(0.0, 1.0, designed_width(baseline.point_probability, learned))

    @classmethod
    def detector(cls, baseline: Baseline) -> tuple[float, float, Array] | None:
        """See `Chart`."""
        return 1.0, designed_width(baseline.point_probability, baseline.learned[0]), np.eye(1)

    @classmethod
    def explain(cls, judgement: Judgement, signal: Shown) -> tuple[str, dict[str, float]]:
        """See `SignalChart`."""
        size, allowed = abs(judgement.statistic) * signal.scale, judgement.upper_limit * signal.scale
        return signal.describe(judgement, size, allowed), {signal.name: 1.0}

    @property
    def mean(self) -> float:
        """Mean of the values when all is well."""
        return self.setting(_MEAN)

    @property
    def lower_limit(self) -> float:
        """Lower limit of the values."""
        return self.setting(_LOWER)

    @property
    def upper_limit(self) -> float:
        """Upper limit of the values."""
        return self.setting(_UPPER)


def designed_width(p: float, learned: Prewhitening) -> float:
    """The width L that a point is beyond with the probability p.

    Args:
        p: probability of a single point.
        learned: the training.
    """
    return false_alarm_budget.widen_limit(float(-special.ndtri(0.5 * p)), 1.0, learned)


def probability_out(width: float) -> float:
    """Probability that a point is out by rule 1 by chance, for independent normal values.

    >>> round(probability_out(3.0), 5)
    0.0027
    """
    return erfc(width / sqrt(2))
