"""Run length of the Shewhart chart with run rules: exact, by the chain of Champ & Woodall (1987), Technometrics 29(4).

A state holds the part of the history that the rules need: on which side each of the last four lies beyond the inner
line and each of the last two beyond the middle one, and how many in a row are on one side. Points that a rule
can no longer count are dropped, so the chain is small: 295 states with all four rules.
"""

from collections.abc import Iterable
from math import inf

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.run_length.arguments import check_length, shift_size
from reactorwatch.spc.run_length.chain import run_lengths, stationary_distribution

RULES = (1, 2, 3, 4)

State = tuple[tuple[int, ...], tuple[int, ...], int]
"""Sides of the last points beyond the inner line, of those beyond the middle line (0: not beyond), and the run."""

START: State = ((0, 0, 0, 0), (0, 0), 0)
_ZONES = (-3, -2, -1, 0, 0, 1, 2, 3)
_SIDES = (-1, -1, -1, -1, 1, 1, 1, 1)


def shewhart(shift: float, width: float = 3.0, rules: Iterable[int] = (1,), *, steady_state: bool = False) -> float:
    """Average run length.

    >>> round(shewhart(0.0), 2)
    370.4

    Args:
        shift: shift of the mean, in sigma.
        width: L, of the outer lines; the others are at thirds of it.
        rules: some of 1, 2, 3, 4, numbered as in `spc/charts/shewhart.py`.
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
    if not wanted or not set(wanted) <= set(RULES):
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
    index = {START: 0}
    todo = [START]
    table: list[list[int]] = []
    while todo:
        state = todo.pop(0)
        targets = []
        for zone, side in zip(_ZONES, _SIDES, strict=True):
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
