"""Sensor noise, estimated from the highest frequencies of a simulation's residual.

A filter takes for sensor noise whatever its model cannot follow, and with it model error that acts at the sensor. To
assess the model error, the noise has to be estimated independently: at high frequencies plant and model error have
almost no power, and the spectrum of noise has a known shape, white or white plus a first-order autoregression. Its two
levels are fitted by Whittle's likelihood (Whittle 1953, Arkiv for Matematik 2).
"""

from collections.abc import Sequence

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.colored_noise import LOW, Noise, power_spectrum
from reactorwatch.kalman.noise_estimation import resolution_sd

ROUNDS = 100
"""Number of multiplicative steps, after which the levels change by less than a thousandth."""

_LEAST_SHARE = 1e-6


def estimate_sensor_noise(
    noise: Noise, outputs: Sequence[str], residual: Array, measured: Array, period_min: float
) -> Array:
    """Standard deviation of each sensor's noise, shape (n_y,), at most the filter's estimate.

    Args:
        noise: the filter's noise levels, with the time constants of coloured noise.
        outputs: names of the outputs.
        residual: measured minus simulated, shape (rows, n_y); NaN where either is missing.
        measured: measurements, shape (rows, n_y); quantisation is noise, too.
        period_min: median sampling period.
    """
    time_min = {item.output: item.time_min for item in noise.colored}
    sd = noise.sensor_sd(outputs)
    for index, name in enumerate(outputs):
        decay = float(np.exp(-period_min / time_min[name])) if name in time_min else 0.0
        level = _high_frequency_sd(residual[:, index], decay)
        sd[index] = min(sd[index], max(level, resolution_sd(measured[:, index])))
    return sd


def _high_frequency_sd(residual: Array, decay: float) -> float:
    """Standard deviation of white noise plus an AR(1) with this coefficient; infinite if the record is too short."""
    spectrum = power_spectrum(residual)
    if spectrum is None:
        return float("inf")
    share, power = (column[spectrum[0] >= LOW[0]] for column in spectrum)
    if decay == 0.0:
        return float(np.sqrt(np.mean(power)))
    shapes = np.stack(
        [np.ones(share.size), (1.0 - decay**2) / (1.0 - 2.0 * decay * np.cos(np.pi * share) + decay**2)], axis=1
    )
    levels = np.full(2, float(np.mean(power)))
    for _ in range(ROUNDS):  # multiplicative steps keep both levels positive
        expected = shapes @ levels
        levels = levels * np.sqrt((shapes.T @ (power / expected**2)) / (shapes.T @ (1.0 / expected)))
        levels = np.maximum(levels, _LEAST_SHARE * levels.max())
    return float(np.sqrt(levels.sum()))
