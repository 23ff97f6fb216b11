"""Limits that an experiment keeps: of the input that is moved, and of the outputs as each rival predicts them."""

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
"""Where nothing is said: the record's range, and to either side the larger of such a share of it and of the scale."""

_TAIL = 0.005
"""Of an output's values, noise and outliers, that its range leaves out at either end."""


def checked_limits(model: ProcessModel, given: Mapping[str, tuple[float, float]]) -> None:
    """Hold that limits can be meant.

    Raises:
        InputError: of no signal of the model, not rising, or beyond what an input can be.
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
    """Those of every signal: as given, else somewhat wider than the record.

    Args:
        run: the record.
        model: of the plant.
        given: by signal, checked.
    """
    scales = {item.name: item.scale for item in (*model.states, *model.inputs)}
    found: Limits = {}
    for item, values in zip(model.inputs, run.inputs.T, strict=True):
        low, high = _widened(float(values.min()), float(values.max()), scales[item.name])
        found[item.name] = (max(low, item.lower), min(high, item.upper))
    for name, values in zip(model.output_names, run.measured.T, strict=True):
        low, high = np.nanquantile(values, [_TAIL, 1.0 - _TAIL]).tolist()
        found[name] = _widened(low, high, scales.get(name, 0.0))
    return found | dict(given)


def within(outputs: Array, limits: Limits, names: tuple[str, ...], margin: Array) -> bool:
    """Whether outputs keep their limits with a margin.

    Args:
        outputs: shape (rows, n_y).
        limits: by signal.
        names: of the outputs.
        margin: of each, shape (n_y,).
    """
    low, high = np.array([limits[name] for name in names]).T
    return bool(np.all((outputs >= low + margin) & (outputs <= high - margin)))


def _widened(low: float, high: float, scale: float) -> tuple[float, float]:
    by = max(WIDER * (high - low), SCALE_SHARE * scale)
    return low - by, high + by
