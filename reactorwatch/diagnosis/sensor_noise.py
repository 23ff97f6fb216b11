"""Noise of sensors, estimated from the highest frequencies of what a simulation leaves.

A filter takes for noise of a sensor whatever its model cannot follow, and with it an error of the model that acts at
that sensor. To judge how much the model errs, the noise has to come from elsewhere: at high frequencies a plant and
what a model lacks show next to nothing, and the spectrum of noise is known there by its shape, white or white and a
first-order autoregression. Its two levels are fitted by Whittle's likelihood (Whittle 1953, Arkiv for Matematik 2).
"""

from collections.abc import Sequence

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.colored_noise import LOW, Noise, power_spectrum
from reactorwatch.diagnosis.fitting.outliers import resolution

ROUNDS = 100
"""Number of multiplicative steps, after which the levels change by less than a thousandth."""

_LEAST_SHARE = 1e-6


def sensor_noise(noise: Noise, outputs: Sequence[str], residual: Array, measured: Array, period_min: float) -> Array:
    """Standard deviation of each sensor's noise, shape (n_y,), at most what the filter takes it for.

    Args:
        noise: that the filter takes, with the memory of each sensor's noise.
        outputs: names of the sensors.
        residual: measured minus simulated by a free run, shape (rows, n_y); NaN where there is neither.
        measured: shape (rows, n_y); rounding is noise, too.
        period_min: usual distance of rows.
    """
    time_min = {item.output: item.time_min for item in noise.wandering}
    found = noise.sensor_sd(outputs)
    for place, name in enumerate(outputs):
        kept = float(np.exp(-period_min / time_min[name])) if name in time_min else 0.0
        level = _high_frequency_sd(residual[:, place], kept)
        rounding = resolution(measured[:, place]) / np.sqrt(12.0)
        found[place] = min(found[place], max(level, rounding))
    return found


def _high_frequency_sd(residual: Array, kept: float) -> float:
    """Standard deviation of white noise and an AR(1) with this coefficient; infinite if the record is too short."""
    spectrum = power_spectrum(residual)
    if spectrum is None:
        return float("inf")
    share, power = (column[spectrum[0] >= LOW[0]] for column in spectrum)
    if kept == 0.0:
        return float(np.sqrt(np.mean(power)))
    shapes = np.stack(
        [np.ones(share.size), (1.0 - kept**2) / (1.0 - 2.0 * kept * np.cos(np.pi * share) + kept**2)], axis=1
    )
    levels = np.full(2, float(np.mean(power)))
    for _ in range(ROUNDS):  # multiplicative steps keep both levels positive
        expected = shapes @ levels
        levels = levels * np.sqrt((shapes.T @ (power / expected**2)) / (shapes.T @ (1.0 / expected)))
        levels = np.maximum(levels, _LEAST_SHARE * levels.max())
    return float(np.sqrt(levels.sum()))
