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
together: every 92nd.

The memory: how many points in a row were on one side (negative below, no more than 8), and the zones of the last
four, counted in thirds of L from the mean.

The run length with run rules is exact, by the chain of Champ & Woodall. A state holds the part of the history that the
rules need: on which side each of the last four lies beyond the inner line and each of the last two beyond the middle
one, and how many in a row are on one side. Points that a rule can no longer count are dropped, so the chain is small:
295 states with all four rules.
"""

from collections.abc import Iterable
from math import erfc, inf, sqrt
from typing import Self

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.charts.base import Baseline, Design, Judgement, Shown, finite
from reactorwatch.spc.compiled_chart import PRESENT, SETTINGS, CompiledChart, X, write_point
from reactorwatch.spc.false_alarm_budget import widen_limit
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.run_length import check_length, limit_for, run_lengths, shift_size, stationary_distribution

_MEAN, _THIRD, _LOWER, _UPPER, _RULE1, _RULE2, _RULE3, _RULE4, _START = range(SETTINGS, SETTINGS + 9)
_RUN, _ZONE1, _ZONE2, _ZONE3, _ZONE4, _END = range(_START + 5, _START + 5 + 6)


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
    memories = 5
    numbers = _END - SETTINGS
    kernel = staticmethod(_judge)

    def __init__(self, mean: float, sigma: float, width: float = 3.0, rules: Iterable[int] = (1,)) -> None:
        positive("sigma", sigma)
        positive("width", width)
        wanted = checked_rules(rules)
        lower, upper = finite(mean) - width * sigma, mean + width * sigma
        flags = [1.0 if rule in wanted else 0.0 for rule in (1, 2, 3, 4)]
        super().__init__([mean, width * sigma / 3.0, lower, upper, *flags], np.zeros(5).tolist())

    @classmethod
    def fastest(cls, arl0: float, shift: float, dimension: int, rules: tuple[int, ...]) -> Design:
        """See `Chart`: it has no memory, so only its limit."""
        limit = shewhart_limit(arl0, rules)
        length = shewhart_run_length(shift, limit, rules)
        return Design(cls.name, {"rules": list(checked_rules(rules)), "limit": limit}, arl0, shift, length)

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
    return widen_limit(float(-special.ndtri(0.5 * p)), 1.0, learned)


def probability_out(width: float) -> float:
    """Probability that a point is out by rule 1 by chance, for independent normal values.

    >>> round(probability_out(3.0), 5)
    0.0027
    """
    return erfc(width / sqrt(2))


def shewhart_limit(arl0: float, rules: Iterable[int] = (1,)) -> float:
    """Width L for an in-control run length."""
    wanted = checked_rules(rules)
    if wanted == (1,):
        return float(-special.ndtri(0.5 / arl0))
    if 4 in wanted and arl0 >= (rule_4 := shewhart_run_length(0.0, 12.0, (4,))):
        raise InputError(f"arl0 must be below {rule_4:g} with rule 4, which depends on no limit, got {arl0:g}")
    return limit_for(arl0, lambda limit: shewhart_run_length(0.0, limit, wanted), 0.5, 30.0)


State = tuple[tuple[int, ...], tuple[int, ...], int]
"""Sides of the last points beyond the inner line, of those beyond the middle line (0: not beyond), and the run."""


def shewhart_run_length(
    shift: float, width: float = 3.0, rules: Iterable[int] = (1,), *, steady_state: bool = False
) -> float:
    """Average run length of a Shewhart chart.

    >>> round(shewhart_run_length(0.0), 2)
    370.4

    Args:
        shift: shift of the mean, in sigma.
        width: L, of the outer lines; the others are at thirds of it.
        rules: some of 1, 2, 3, 4.
        steady_state: whether the chart has long run when the shift occurs.

    Raises:
        InputError: an argument out of its range.
    """
    positive("limit", width)
    wanted = checked_rules(rules)
    delta = shift_size(shift)
    table = _transition_table(wanted)
    transitions = _transitions(table, width, delta)
    lengths = run_lengths(transitions)
    check_length(float(lengths[0]))
    if steady_state:
        return float(stationary_distribution(_transitions(table, width, 0.0)) @ lengths)
    return float(lengths[0])


def checked_rules(rules: Iterable[int]) -> tuple[int, ...]:
    """The rules, each once and in order.

    Raises:
        InputError: there is none, or one that does not exist.
    """
    wanted = tuple(sorted(set(rules)))
    if not wanted or not set(wanted) <= {1, 2, 3, 4}:
        raise InputError(f"rules must be some of 1, 2, 3, 4, got {wanted}")
    return wanted


def _transitions(table: list[list[int]], width: float, shift: float) -> Array:
    lines = np.array([-inf, -3, -2, -1, 0, 1, 2, 3, inf]) * width / 3.0 - shift
    # From the nearer tail, so that a small probability keeps its digits.
    upper_half = lines[:-1] >= 0.0
    zones = np.where(
        upper_half,
        special.ndtr(-lines[:-1]) - special.ndtr(-lines[1:]),
        special.ndtr(lines[1:]) - special.ndtr(lines[:-1]),
    )
    transitions = np.zeros((len(table), len(table)))
    for state, targets in enumerate(table):
        for target, probability in zip(targets, zones, strict=True):
            if target >= 0:
                transitions[state, target] += probability
    return transitions


def _transition_table(rules: tuple[int, ...]) -> list[list[int]]:
    """Next state after each of the eight zones, for each reachable state; -1 for a signal."""
    start: State = ((0, 0, 0, 0), (0, 0), 0)
    index, todo = {start: 0}, [start]
    table: list[list[int]] = []
    while todo:
        state = todo.pop(0)
        targets = []
        # Zone and side of a point, from the lowest to the highest.
        for zone, side in ((-3, -1), (-2, -1), (-1, -1), (0, -1), (0, 1), (1, 1), (2, 1), (3, 1)):
            target = _next_state(state, zone, side, rules)
            if target is not None and target not in index:
                index[target] = len(index)
                todo.append(target)
            targets.append(-1 if target is None else index[target])
        table.append(targets)
    return table


def _next_state(state: State, zone: int, side: int, rules: tuple[int, ...]) -> State | None:
    """Next state after a point in a zone; None if it completes a pattern."""
    inner, middle, run = state
    if 1 in rules and abs(zone) == 3:
        return None
    if 2 in rules:
        if abs(zone) >= 2 and side in middle:
            return None
        middle = (side if abs(zone) >= 2 else 0, middle[0])
    if 3 in rules:
        if abs(zone) >= 1 and inner.count(side) >= 3:
            return None
        inner = _drop_expired((side if abs(zone) >= 1 else 0, *inner[:3]))
    if 4 in rules:
        run = run + side if run * side > 0 else side
        if abs(run) >= 8:
            return None
    return inner, middle, run


def _drop_expired(inner: tuple[int, ...]) -> tuple[int, ...]:
    """Drop points that leave the window of five before four of their side can be in it."""
    kept = list(inner)
    for age in range(len(inner)):
        # Until the point of this age leaves, there is room for 4 - age more points.
        if kept[age] and inner[: age + 1].count(inner[age]) + (4 - age) < 4:
            kept[age] = 0
    return tuple(kept)
