"""Coloured sensor noise: white noise plus a first-order Gauss-Markov part.

The coloured part is v <- phi v + white noise, with phi = exp(-h / tau) over a row of length h: a first-order
autoregression from row to row, uncorrelated between rows far apart. The filter has it as one more state, initially
zero, that is added to the sensor's output (Bryson & Johansen 1965, Linear filtering for time-varying systems using
measurements containing colored noise, IEEE Trans. Automatic Control 10). Its standard deviation and time constant are
estimated here with the other noise levels, by maximum likelihood (`estimate_noise`).

More states make a filter slower, so coloured noise is modelled only where the record calls for it. Model error and
process noise have almost no power at high frequencies; white noise has the same power at all of them. So the power of
the simulation's residual in the band `LOW` is compared with that in the band `HIGH`.

Sensor noise, estimated from the highest frequencies of a simulation's residual. A filter takes for sensor noise
whatever its model cannot follow, and with it model error that acts at the sensor. To assess the model error, the noise
has to be estimated independently: at high frequencies plant and model error have almost no power, and the spectrum of
noise has a known shape, white or white plus a first-order autoregression. Its two levels are fitted by Whittle's
likelihood (Whittle 1953, Arkiv for Matematik 2).
"""

from collections.abc import Sequence
from dataclasses import replace
from math import exp, sqrt

import casadi as ca
import msgspec
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.noise_estimation import fit_noise, resolution_sd
from reactorwatch.process.model import ProcessModel, parameter, variable

LOW, HIGH = (0.375, 0.625), (0.75, 1.0)
"""Frequency bands, as fractions of the Nyquist frequency."""

SUSPICIOUS = 1.25
"""Ratio of the power in `LOW` to that in `HIGH`. An autoregression of 0.2 has 1.3, one of 0.5 has 1.6."""

CUT = 4.0
"""Standard deviations at which values are clipped."""

SHORTEST_ROWS, LONGEST_ROWS, FIRST_ROWS = 0.3, 10.0, 1.5
"""Bounds of the time constant and its initial value, in rows."""

SHORTEST_MIN = 0.03
"""Lower bound of the time constant: the integrator's step is up to 0.05 min and cannot resolve faster dynamics."""

_FEWEST_ROWS = 200
_SCALES = 10.0  # the state's scale, in standard deviations of the sensor's noise


class ColoredNoise(msgspec.Struct, frozen=True):
    """The coloured part of a sensor's noise.

    Attributes:
        output: name of the sensor's output.
        sd: stationary standard deviation, in the output's unit.
        time_min: time constant in minutes.
        driving_sd: standard deviation of the driving white noise, in the output's unit per square root of a minute.
        scale: standard deviation of the sensor's total noise if it were white.
    """

    output: str
    sd: float
    time_min: float
    driving_sd: float
    scale: float


class Noise(NoiseLevels, frozen=True):
    """Noise levels of a plant and its sensors.

    Attributes:
        colored: coloured parts of the sensors' noise; `measurement_sd` is that of the white parts.
    """

    colored: tuple[ColoredNoise, ...] = ()

    def sensor_sd(self, outputs: Sequence[str]) -> Array:
        """Standard deviation of each sensor's total noise, shape (n_y,)."""
        of = {item.output: item.sd for item in self.colored}
        return np.hypot(self.measurement_sd, [of.get(name, 0.0) for name in outputs])

    @property
    def parameter_changes(self) -> dict[str, float]:
        """Time constants as changes of model parameters, by name."""
        return {f"{item.output}.noise_min": item.time_min for item in self.colored}


def detect_colored_noise(
    noise: NoiseLevels, outputs: Sequence[str], residual: Array, period_min: float
) -> tuple[ColoredNoise, ...]:
    """Find sensors whose noise may be coloured. The initial estimate has the standard deviation of the white noise.

    Args:
        noise: noise levels estimated with white sensor noise.
        outputs: names of the outputs.
        residual: residual of the simulation, shape (rows, n_y); NaN where not measured.
        period_min: median sampling period.
    """
    result = []
    for name, sd, column in zip(outputs, noise.measurement_sd, residual.T, strict=True):
        if _power_ratio(column) > SUSPICIOUS:
            result.append(ColoredNoise(name, sd, _initial_tau_min(period_min), _initial_driving_sd(sd, period_min), sd))
    return tuple(result)


def add_colored_noise(model: ProcessModel, colored: Sequence[ColoredNoise], period_min: float) -> ProcessModel:
    """Add a state of coloured noise to each of these sensors."""
    for item in colored:
        index = model.output_names.index(item.output)
        output = model.outputs[index]
        scale = _SCALES * item.scale
        noise = variable(f"{item.output}.noise", output.unit, (-1e3 * scale, 1e3 * scale), scale, "coloured noise")
        shortest = max(SHORTEST_ROWS * period_min, SHORTEST_MIN)
        bounds = (shortest, max(LONGEST_ROWS * period_min, 2.0 * shortest))
        time = parameter(
            f"{item.output}.noise_min", _initial_tau_min(period_min), "min", bounds, "time constant of the noise"
        )
        model = model.with_state(noise, -noise.symbol / time.symbol, ca.SX(0.0))
        shown = replace(output, expression=output.expression + noise.symbol)
        outputs = (*model.outputs[:index], shown, *model.outputs[index + 1 :])
        model = replace(model, outputs=outputs, parameters=(*model.parameters, time))
    return model


def estimate_noise(
    model: ProcessModel,
    record: FilterRecord,
    noise: Noise,
    smallest_sd: Sequence[float],
    nearby: Sequence[NoiseLevels],
    period_min: float,
) -> Noise:
    """Estimate all noise levels, those of coloured noise among them, by maximum likelihood.

    Args:
        model: model with the states that `add_colored_noise` has added.
        record: rows as the filter takes them.
        noise: noise with the coloured parts.
        smallest_sd: least standard deviation of each sensor's noise.
        nearby: levels that are further initial values.
        period_min: median sampling period.
    """
    times = noise.parameter_changes
    # Start again from a short time constant: model error makes it seem long, and the search would stay there.
    first_sd = {f"{item.output}.noise": _initial_driving_sd(item.scale, period_min) for item in noise.colored}
    found = fit_noise(model, record, smallest_sd, tuple(times), first_sd, nearby, lacking=True)
    levels, colored = found.levels, []
    of_sensors = len(levels.process_sd) - len(noise.colored)
    for item, rate in zip(noise.colored, levels.process_sd[of_sensors:], strict=True):
        time_min = found.parameters[f"{item.output}.noise_min"]
        sd = rate / _driving_sd(1.0, time_min, period_min)
        colored.append(ColoredNoise(item.output, sd, time_min, rate, item.scale))
    return Noise(levels.measurement_sd, levels.process_sd[:of_sensors], tuple(colored))


def _initial_tau_min(period_min: float) -> float:
    return max(FIRST_ROWS * period_min, SHORTEST_MIN)


def _initial_driving_sd(sd: float, period_min: float) -> float:
    return _driving_sd(sd, _initial_tau_min(period_min), period_min)


def _driving_sd(sd: float, time_min: float, period_min: float) -> float:
    """Driving noise that keeps the stationary standard deviation.

    The filter adds its variance times the row's length.
    """
    return sd * sqrt((1.0 - exp(-2.0 * period_min / time_min)) / period_min)


def power_spectrum(residual: Array) -> tuple[Array, Array] | None:
    """Power at frequencies that are fractions of the Nyquist frequency; None if the residual is too short.

    White noise has on average its variance at all of them. Missing values are skipped, outliers are clipped.
    """
    differences = np.diff(residual[np.isfinite(residual)])  # the low frequencies would mask the highest
    if differences.size < _FEWEST_ROWS:
        return None
    limit = CUT * float(np.median(np.abs(differences))) / 0.6745
    power = np.abs(np.fft.rfft(np.clip(differences, -limit, limit))) ** 2 / differences.size
    share = np.linspace(0.0, 1.0, power.size)
    power[1:] /= 2.0 - 2.0 * np.cos(np.pi * share[1:])
    return share, power


def _power_ratio(residual: Array) -> float:
    """Power of a residual in `LOW` over that in `HIGH`; 1 if it is too short."""
    spectrum = power_spectrum(residual)
    if spectrum is None:
        return 1.0
    share, power = spectrum
    low, high = (float(np.mean(power[(share >= begin) & (share < end)])) for begin, end in (LOW, HIGH))
    return low / high if high > 0.0 else 1.0


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
