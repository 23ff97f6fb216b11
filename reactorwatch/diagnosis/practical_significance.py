"""Whether a difference matters in practice: that is for the user to say."""

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
"""Of an output's range in the record: a difference in it that matters, where the user does not say."""


def checked_tolerance(model: ProcessModel, tolerance: Mapping[str, float]) -> None:
    """Hold that tolerances can be meant.

    Raises:
        InputError: as `bands_of`.
    """
    for name, value in tolerance.items():
        if name not in model.output_names:
            raise InputError(f"tolerance must be of {', '.join(model.output_names)}, got {name}")
        if not 0.0 < value < np.inf:
            raise InputError(f"tolerance of {name} must be a positive number, got {value:g}")


def bands_of(run: Run, model: ProcessModel, tolerance: Mapping[str, float]) -> dict[str, float]:
    """The root mean square difference in each output that does not matter, in its unit.

    Args:
        run: the record.
        model: of the plant.
        tolerance: as the user has it, by output.

    Raises:
        InputError: a tolerance is of no output, or not positive.
    """
    checked_tolerance(model, tolerance)
    ranges = np.nanquantile(run.measured, 0.99, axis=0) - np.nanquantile(run.measured, 0.01, axis=0)
    return {
        name: tolerance.get(name, PRACTICAL_SHARE * float(size))
        for name, size in zip(model.output_names, ranges, strict=True)
    }


def matters(curves: Curves, bands: Mapping[str, float], blind: NDArray[np.bool_]) -> bool:
    """Compare the simulations by both models with the tolerances; true if an output differs by more.

    Args:
        curves: of both models.
        bands: the tolerances, by output.
        blind: rows of which the filter says nothing, as of the first row of a run, shape (rows,).
    """
    for output, band in bands.items():
        difference = (curves.free_after[output] - curves.free_before[output])[~blind]
        known = difference[np.isfinite(difference)]
        if known.size < difference.size or float(np.sqrt(np.mean(known**2))) > band:
            return True
    return False


def left_matters(before: Errors, noise_sd: Array, model: ProcessModel, bands: Mapping[str, float]) -> bool:
    """Practical significance: true if the nominal free run errs by more than noise and tolerance in an output.

    Args:
        before: errors of the nominal model.
        noise_sd: of the sensors, shape (n_y,); without what a filter takes for their noise, see `sensor_noise`.
        model: of the plant.
        bands: tolerances, by output.
    """
    left = np.sqrt(np.maximum(before.free**2 - noise_sd**2, 0.0))
    return any(not value <= bands[name] for name, value in zip(model.output_names, left.tolist(), strict=True))
