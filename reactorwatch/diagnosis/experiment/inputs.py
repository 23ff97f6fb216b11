"""Inputs of an experiment: candidate sequences, and the limits that they must keep.

Candidate inputs for an experiment: sequences of held levels. Different causes need different inputs: a wide range of
operating points if both act on the balances, quick changes if one is a lag. So the families range from short to long
holds, each between the two ends alone (a random binary sequence; Ljung 1999, System identification, 13.3) and through
all levels between. They are random with a fixed seed, and the best is improved by exchanging parts, as Fedorov (1972,
Theory of optimal experiments, 3) exchanges points.

Constraints of an experiment: limits of the input and of the outputs that each alternative predicts.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import ceil, floor, isfinite, log10
from typing import TypeAlias

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.run import Run
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel

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


Limits: TypeAlias = dict[str, tuple[float, float]]
"""Lowest and highest value, by signal."""

WIDER, SCALE_SHARE = 0.25, 0.5
"""Default limits: the record's range, widened on either side by the larger of a fraction of it and of the scale."""

_TAIL = 0.005
"""Fraction of an output's values, noise and outliers, that is cut off either end of its range."""


def check_limits(model: ProcessModel, given: Mapping[str, tuple[float, float]]) -> None:
    """Check that limits are valid.

    Raises:
        InputError: a limit of no signal of the model, not increasing, or beyond an input's bounds.
    """
    inputs = {item.name: item for item in model.inputs}
    for name, (low, high) in given.items():
        if name not in (*inputs, *model.output_names):
            raise InputError(f"limits must be of {', '.join((*inputs, *model.output_names))}, got {name}")
        if not (isfinite(low) and isfinite(high) and low < high):
            raise InputError(f"limits of {name} must be two rising numbers, got {low:g}..{high:g}")
        if name in inputs and not (inputs[name].lower <= low and high <= inputs[name].upper):
            item = inputs[name]
            raise InputError(
                f"limits of {name} must be within {item.lower:g}..{item.upper:g} {item.unit}, got {low:g}..{high:g}"
            )


def limits_of(run: Run, model: ProcessModel, given: Mapping[str, tuple[float, float]]) -> Limits:
    """Limits of every signal: as given, else somewhat wider than the record.

    Args:
        run: the record.
        model: process model of the plant.
        given: checked limits, by signal.
    """
    scales = {item.name: item.scale for item in (*model.states, *model.inputs)}
    result: Limits = {}
    for item, values in zip(model.inputs, run.inputs.T, strict=True):
        low, high = _widen(float(values.min()), float(values.max()), scales[item.name])
        result[item.name] = (max(low, item.lower), min(high, item.upper))
    for name, values in zip(model.output_names, run.measured.T, strict=True):
        low, high = np.nanquantile(values, [_TAIL, 1.0 - _TAIL]).tolist()
        result[name] = _widen(low, high, scales.get(name, 0.0))
    return result | dict(given)


def keeps_limits(outputs: Array, limits: Limits, names: tuple[str, ...], margin: Array) -> bool:
    """Return true if outputs keep their limits with a margin.

    Args:
        outputs: shape (rows, n_y).
        limits: limits by signal.
        names: names of the outputs.
        margin: margin of each output, shape (n_y,).
    """
    low, high = np.array([limits[name] for name in names]).T
    return bool(np.all((outputs >= low + margin) & (outputs <= high - margin)))


def _widen(low: float, high: float, scale: float) -> tuple[float, float]:
    by = max(WIDER * (high - low), SCALE_SHARE * scale)
    return low - by, high + by
