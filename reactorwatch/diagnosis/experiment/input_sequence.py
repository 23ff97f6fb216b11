"""Candidate inputs for an experiment: sequences of held levels.

Different causes need different inputs: a wide range of operating points if both act on the balances, quick changes if
one is a lag. So the families range from short to long holds, each between the two ends alone (a random binary sequence;
Ljung 1999, System identification, 13.3) and through all levels between. They are random with a fixed seed, and the best
is improved by exchanging parts, as Fedorov (1972, Theory of optimal experiments, 3) exchanges points.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil, floor, log10

import numpy as np

from reactorwatch.arrays import Array

HOLDS_ROWS = (5, 10, 20, 50, 100)
SEED = 1
QUIET_ROWS = 50
"""Rows at the first level before the input moves, so that the initial state does not matter."""

EXCHANGED_SHARE = 0.1
EXCHANGES = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)
DIGITS = 100.0
"""Minimum number of levels that the rounding leaves in the range."""


@dataclass(frozen=True)
class InputRange:
    """Range of an input, and its level at rest."""

    low: float
    high: float
    rest: float

    def levels(self, shares: Array) -> Array:
        """Map -1 (lowest), 0 (rest) and 1 (highest) to levels, rounded to few digits."""
        reach = np.where(shares > 0.0, self.high - self.rest, self.rest - self.low)
        decimals = ceil(-log10(max(self.high - self.low, 1e-9) / DIGITS))
        inward = (floor(self.high * 10.0**decimals), ceil(self.low * 10.0**decimals))
        rounded = np.round((self.rest + shares * reach) * 10.0**decimals)
        return np.asarray(np.clip(rounded, inward[1], inward[0]) / 10.0**decimals)


@dataclass(frozen=True, eq=False)
class InputSequence:
    """Levels that are held for equal times.

    Attributes:
        hold_rows: number of rows of each level.
        shares: relative levels, see `InputRange.levels`, shape (holds,).
    """

    hold_rows: int
    shares: Array

    def shrink(self, by: float) -> "InputSequence":
        """Move all levels towards the rest."""
        return InputSequence(self.hold_rows, by * self.shares)

    def first(self, holds: int) -> "InputSequence":
        """Keep the first levels alone."""
        return InputSequence(self.hold_rows, self.shares[:holds])

    def exchange(self, random: np.random.Generator) -> "InputSequence":
        """Replace some neighbouring levels by random ones."""
        count = max(round(EXCHANGED_SHARE * self.shares.size), 1)
        begin = int(random.integers(0, self.shares.size - count + 1))
        shares = self.shares.copy()
        shares[begin : begin + count] = random.choice(EXCHANGES, count)
        return InputSequence(self.hold_rows, shares)

    def levels(self, ends: InputRange, rows: int) -> Array:
        """Level of each row, shape (rows,)."""
        shares = np.concatenate([np.zeros(QUIET_ROWS), np.repeat(self.shares, self.hold_rows)])[:rows]
        return ends.levels(shares)


def initial_sequences(rows: int) -> Iterator[InputSequence]:
    """Initial sequences of this number of rows."""
    for hold_rows in HOLDS_ROWS:
        count = ceil((rows - QUIET_ROWS) / hold_rows)
        random = np.random.default_rng([SEED, hold_rows])
        yield InputSequence(hold_rows, random.permutation(np.resize([-1.0, 1.0], count)))
        yield InputSequence(hold_rows, random.permutation(np.linspace(-1.0, 1.0, count)))


def staircase(rows_a_step: int, steps: int, towards: float) -> InputSequence:
    """Steps from the rest to one end."""
    return InputSequence(rows_a_step, towards * np.arange(1, steps + 1) / steps)
