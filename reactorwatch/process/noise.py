"""How noisy a process and its sensors are, learned from a record of a time when all was well.

The filter's gain follows from two kinds of noise: that of the sensors, and that of the process, which stands for all
that moves the state and is not in the model. Both are chosen by the likelihood of the innovations (Schweppe 1965,
Evaluation of likelihood functions for Gaussian signals, IEEE Trans. Information Theory 11): with the process noise
given on a coarse grid, one state after the other, the sensors' follows from the innovations, whose mean square has to
be what the filter expects. Without process noise as one of the choices, a plant that the model describes perfectly is
described so. What is far off counts as `CLIP` standard deviations (Huber 1964), so that outliers do not pass for noise.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from reactorwatch.process.filter import Filter, NoiseLevels
from reactorwatch.process.model import Array, ProcessModel

SHARES = (0.0, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0)
"""Process noise to choose from, in scales of the state per square root of a minute."""

CLIP = 2.5
"""Standard deviations that a value counts as at most."""

GATE = 6.0
MOST_STEPS, MOST_SWEEPS = 6, 3
SETTLED = 0.01
LEAST_GAIN = 1.0
"""In log likelihood: less does not make a plant noisier."""

BURN_IN = 20
"""Rows at the start in which the filter still finds its state."""

_OF_THIRD_DIFFERENCES = 0.6745 * np.sqrt(20.0)  # their median size, for white noise of unit variance
_MEAN_SQUARE_CLIPPED = 0.9776  # of normal values clipped at CLIP


@dataclass(frozen=True)
class _Trial:
    """Noise levels, how unlikely they make the record, and what the sensors' noise then looks like."""

    noise: NoiseLevels
    loss: float
    sensors: tuple[float, ...]


def tune(model: ProcessModel, time_min: Array, inputs: Array, measured: Array, smallest_sd: list[float]) -> NoiseLevels:
    """The noise levels under which a record is likeliest.

    Args:
        model: of the plant.
        time_min: shape (rows,), increasing.
        inputs: shape (rows,) or (rows, n_u).
        measured: shape (rows, n_y); NaN where missing or not to be learned from.
        smallest_sd: of the sensors, one an output, in its unit: theirs are at least so large.
    """
    smallest = np.asarray(smallest_sd)
    scales = np.array([state.scale for state in model.states])
    kalman = Filter(model, NoiseLevels(tuple(np.maximum(_rough(measured), smallest).tolist()), (0.0,) * scales.size))

    def tried(noise: NoiseLevels) -> _Trial:
        kalman.noise = noise
        found = kalman.run(time_min, inputs, measured, gate=GATE)
        residual, sd = found.residual, found.sd
        residual, sd = residual[BURN_IN:], sd[BURN_IN:]
        squares = np.minimum((residual / sd) ** 2, CLIP**2)
        loss = float(np.nansum(np.log(sd) + 0.5 * squares))
        # Only the sensors' part of the variance is scaled; the process' has been given.
        variance = np.square(noise.measurement_sd)
        of_process = np.nanmean(sd**2, axis=0) - variance
        wanted = np.nanmean(squares, axis=0) / _MEAN_SQUARE_CLIPPED * (variance + of_process) - of_process
        sensors = np.sqrt(np.maximum(np.nan_to_num(wanted), smallest**2))
        return _Trial(noise, loss if np.isfinite(loss) else np.inf, tuple(sensors.tolist()))

    def settled(best: _Trial) -> _Trial:
        """With the sensors' noise that belongs to it."""
        for _ in range(MOST_STEPS):
            if np.allclose(best.sensors, best.noise.measurement_sd, rtol=SETTLED):
                break
            best = tried(NoiseLevels(best.sensors, best.noise.process_sd))
        return best

    best = settled(tried(kalman.noise))
    places = [0] * scales.size
    for _ in range(MOST_SWEEPS):
        before = best.loss
        for state in range(scales.size):
            for step in (1, -1):
                best, places[state] = _climbed(tried, best, places[state], state, step, float(scales[state]))
        best = settled(best)
        if best.loss >= before:
            break
    return best.noise


def _climbed(
    tried: Callable[[NoiseLevels], _Trial], best: _Trial, place: int, state: int, step: int, scale: float
) -> tuple[_Trial, int]:
    """Along the shares of one state, until two in a row are no better."""
    worse, at = 0, place + step
    while 0 <= at < len(SHARES) and worse < 2:
        process = list(best.noise.process_sd)
        process[state] = SHARES[at] * scale
        trial = tried(NoiseLevels(best.noise.measurement_sd, tuple(process)))
        if trial.loss < best.loss - LEAST_GAIN:
            best, place, worse = trial, at, 0
        else:
            worse += 1
        at += step
    return best, place


def _rough(measured: Array) -> Array:
    """A first guess of the sensors' noise: third differences leave little of what the process does."""
    third = np.abs(np.diff(measured, n=3, axis=0))
    with np.errstate(all="ignore"):
        return np.asarray(np.nan_to_num(np.nanmedian(third, axis=0) / _OF_THIRD_DIFFERENCES))
