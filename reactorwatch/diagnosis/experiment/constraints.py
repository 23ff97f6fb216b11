"""Constraints of an experiment: limits of the input and of the outputs that each alternative predicts."""

from collections.abc import Mapping
from math import isfinite
from typing import TypeAlias

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.run import Run
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel

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
