"""Inputs that may be tried in an experiment: levels held in turn.

What tells two causes apart differs: a wide range of operating points where both act on the balances, quick changes
where one of them is a lag. So the families go from short to long holds, each between the two ends alone (a random
binary sequence; Ljung 1999, System identification, 13.3) and through all levels in between. They are random, of a fixed
seed, and the best is improved by exchanging parts of it, as Fedorov (1972, Theory of optimal experiments, 3) exchanges
points.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil, floor, log10

import numpy as np

from reactorwatch.arrays import Array

HOLDS_ROWS = (5, 10, 20, 50, 100)
SEED = 1
QUIET_ROWS = 50
"""At the first level, before anything moves, so that it does not matter where the plant comes from."""

EXCHANGED_SHARE = 0.1
EXCHANGES = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)
DIGITS = 100.0
"""A level is written so that the range has at least so many of them."""


@dataclass(frozen=True)
class Ends:
    """Between which an input moves, and where it rests."""

    low: float
    high: float
    rest: float

    def levels(self, shares: Array) -> Array:
        """From -1 (the lowest) over 0 (the rest) to 1 (the highest), rounded as a person would write them."""
        reach = np.where(shares > 0.0, self.high - self.rest, self.rest - self.low)
        decimals = ceil(-log10(max(self.high - self.low, 1e-9) / DIGITS))
        inward = (floor(self.high * 10.0**decimals), ceil(self.low * 10.0**decimals))
        rounded = np.round((self.rest + shares * reach) * 10.0**decimals)
        return np.asarray(np.clip(rounded, inward[1], inward[0]) / 10.0**decimals)


@dataclass(frozen=True, eq=False)
class InputSequence:
    """Levels that are held for a time each.

    Attributes:
        hold_rows: for how many rows each is held.
        shares: see `Ends.levels`, shape (holds,).
    """

    hold_rows: int
    shares: Array

    def smaller(self, by: float) -> "InputSequence":
        """All levels nearer to the rest."""
        return InputSequence(self.hold_rows, by * self.shares)

    def first(self, holds: int) -> "InputSequence":
        """Its first levels."""
        return InputSequence(self.hold_rows, self.shares[:holds])

    def exchanged(self, random: np.random.Generator) -> "InputSequence":
        """With some neighbouring levels exchanged for others."""
        count = max(round(EXCHANGED_SHARE * self.shares.size), 1)
        begin = int(random.integers(0, self.shares.size - count + 1))
        shares = self.shares.copy()
        shares[begin : begin + count] = random.choice(EXCHANGES, count)
        return InputSequence(self.hold_rows, shares)

    def levels(self, ends: Ends, rows: int) -> Array:
        """The input of each row, shape (rows,)."""
        shares = np.concatenate([np.zeros(QUIET_ROWS), np.repeat(self.shares, self.hold_rows)])[:rows]
        return ends.levels(shares)


def families(rows: int) -> Iterator[InputSequence]:
    """Sequences to begin with, each for so many rows."""
    for hold_rows in HOLDS_ROWS:
        count = ceil((rows - QUIET_ROWS) / hold_rows)
        random = np.random.default_rng([SEED, hold_rows])
        yield InputSequence(hold_rows, random.permutation(np.resize([-1.0, 1.0], count)))
        yield InputSequence(hold_rows, random.permutation(np.linspace(-1.0, 1.0, count)))


def staircase(rows_a_step: int, steps: int, towards: float) -> InputSequence:
    """From the rest to one end, step by step."""
    return InputSequence(rows_a_step, towards * np.arange(1, steps + 1) / steps)
