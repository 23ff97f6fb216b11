"""Covering arrays: few combinations of option values in which each pair of values of two options occurs."""

import random
from collections.abc import Mapping, Sequence
from itertools import combinations, product

TRIES = 20
"""Number of candidates of a row, of which the one with the most new pairs is taken."""

Row = dict[str, str]


def covering_array(options: Mapping[str, Sequence[str]], seed: int = 1) -> list[Row]:
    """Rows with a value of each option, in which each pair of values of two options occurs at least once.

    Each row is built greedily from a pair that is not covered yet (Cohen, Dalal, Fredman & Patton 1997, The AETG
    system, IEEE Trans. Software Engineering 23).

    Args:
        options: possible values of each option, by name.
        seed: seed of the order in which options are chosen.
    """
    draw = random.Random(seed)
    open_pairs = {
        ((one, a), (other, b))
        for one, other in combinations(options, 2)
        for a, b in product(options[one], options[other])
    }
    rows = []
    while open_pairs:
        tries = [_fill(dict(draw.choice(sorted(open_pairs))), options, open_pairs, draw) for _ in range(TRIES)]
        best = max(tries, key=lambda row: len(pairs_of(row, options) & open_pairs))
        open_pairs -= pairs_of(best, options)
        rows.append(best)
    return rows


def pairs_of(row: Row, options: Mapping[str, Sequence[str]]) -> set[tuple[tuple[str, str], tuple[str, str]]]:
    """The pairs of values in a row."""
    return set(combinations([(name, row[name]) for name in options if name in row], 2))


def _fill(
    row: Row,
    options: Mapping[str, Sequence[str]],
    open_pairs: set[tuple[tuple[str, str], tuple[str, str]]],
    draw: random.Random,
) -> Row:
    """Fill the other options in random order, each with the value that covers the most new pairs."""
    for name in draw.sample(sorted(set(options) - set(row)), len(options) - len(row)):
        values = draw.sample(list(options[name]), len(options[name]))
        row[name] = max(values, key=lambda value: len(pairs_of(row | {name: value}, options) & open_pairs))
    return row
