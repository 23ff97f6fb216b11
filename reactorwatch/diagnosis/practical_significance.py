"""Practical significance: compare differences with user-given tolerances."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.holdout import Errors
from reactorwatch.diagnosis.result import Curves
from reactorwatch.diagnosis.run import Run
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel

PRACTICAL_SHARE = 0.02
"""Default tolerance as a fraction of the output's range in the record."""


def check_tolerance(model: ProcessModel, tolerance: Mapping[str, float]) -> None:
    """Check that tolerances are valid.

    Raises:
        InputError: a tolerance is of no output, or not positive.
    """
    for name, value in tolerance.items():
        if name not in model.output_names:
            raise InputError(f"tolerance must be of {', '.join(model.output_names)}, got {name}")
        if not 0.0 < value < np.inf:
            raise InputError(f"tolerance of {name} must be a positive number, got {value:g}")


def tolerances_of(run: Run, model: ProcessModel, tolerance: Mapping[str, float]) -> dict[str, float]:
    """Tolerated root mean square difference of each output, in its unit.

    Args:
        run: the record.
        model: process model of the plant.
        tolerance: tolerances given by the user, by output.

    Raises:
        InputError: a tolerance is of no output, or not positive.
    """
    check_tolerance(model, tolerance)
    ranges = np.nanquantile(run.measured, 0.99, axis=0) - np.nanquantile(run.measured, 0.01, axis=0)
    return {
        name: tolerance.get(name, PRACTICAL_SHARE * float(size))
        for name, size in zip(model.output_names, ranges, strict=True)
    }


def exceeds_tolerance(curves: Curves, bands: Mapping[str, float], blind: NDArray[np.bool_]) -> bool:
    """Return true if the simulations of the two models differ by more than the tolerance in an output.

    Args:
        curves: simulations of both models.
        bands: the tolerances, by output.
        blind: rows without a prediction of the filter, such as the first row of a run, shape (rows,).
    """
    for output, band in bands.items():
        difference = (curves.simulated_after[output] - curves.simulated_before[output])[~blind]
        finite = difference[np.isfinite(difference)]
        if finite.size < difference.size or float(np.sqrt(np.mean(finite**2))) > band:
            return True
    return False


def residual_exceeds_tolerance(
    before: Errors, noise_sd: Array, model: ProcessModel, bands: Mapping[str, float]
) -> bool:
    """Return true if the nominal simulation's error exceeds noise and tolerance in an output.

    Args:
        before: errors of the nominal model.
        noise_sd: standard deviation of the sensors' noise, shape (n_y,), see `high_frequency_noise`.
        model: process model of the plant.
        bands: tolerances, by output.
    """
    residual = np.sqrt(np.maximum(before.simulation**2 - noise_sd**2, 0.0))
    return any(not value <= bands[name] for name, value in zip(model.output_names, residual.tolist(), strict=True))
