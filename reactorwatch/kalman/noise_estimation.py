"""Maximum-likelihood estimation of process and sensor noise from a record of normal operation.

The filter's gain follows from two kinds of noise: that of the sensors, and that of the process, which stands for all
that moves the state and is not in the model. Both maximise the likelihood of the innovations (Schweppe 1965, Evaluation
of likelihood functions for Gaussian signals, IEEE Trans. Information Theory 11), by scoring (Gupta & Mehra 1974,
Computational aspects of maximum likelihood estimation and reduction in sensitivity function calculations, IEEE Trans.
Automatic Control 19): with theta the logarithms of all standard deviations, w the normalised innovations and d the
logarithms of their scales, differences of a few runs of the filter give

    gradient = sum(d' + w w'),    information = sum(w'^2 + d'^2),    step = -gradient / information,

and steps are shortened until they improve. The search starts with the best of a few process noises that move every
state alike, and with sensor noises for which the innovations' mean square is as expected. At the end the noise of a
state is removed if the record does not need it: a plant that the model describes perfectly has no process noise.

Constant states (`ProcessModel.constant_states`) have no noise. Other parameters of the model that the likelihood
depends on, such as the time constant of a sensor's coloured noise, are estimated together with the noise: their
logarithms are further components of theta.

Estimation is robust: values beyond `GATE` standard deviations are left out, and the loss is constant beyond `CLIP`. So
that the tails of normal noise do not count as outliers, squares are compared with those of normal values that are cut
off alike (Huber 1981, Robust Statistics, ch. 5).
"""

from collections.abc import Mapping, Sequence
from math import erf, exp, inf, pi, sqrt
from typing import NamedTuple

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES
from reactorwatch.kalman.batch import GATE, FilterRecord, FilterResult, run_together
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.model import ProcessModel

INITIAL_SHARES = (0.3, 0.03, 0.003)
"""Initial process noise, in scales of the state per square root of a minute; the noisiest converges best."""

CLIP = 4.0  # standard deviations beyond which the loss of a value is constant
FIRST_ROWS = 300  # that the first steps of the search use
_CUT_MEAN_SQUARE = erf(CLIP / sqrt(2)) - CLIP * sqrt(2 / pi) * exp(-(CLIP**2) / 2)  # of w where |w| < CLIP, else 0


class NoiseFit(NamedTuple):
    """Result of a search for noise levels.

    Attributes:
        levels: noise levels.
        parameters: values of the parameters that were estimated with them, by name.
        loss: minus the log likelihood.
        w: normalised innovations, shape (rows, n_y); 0 where there are none and where the filter converges.
    """

    levels: NoiseLevels
    parameters: dict[str, float]
    loss: float
    w: Array


class _Trial(NamedTuple):
    """Logarithms of all noise levels and parameters, and the loss, w and d that they give (see the module)."""

    theta: Array
    loss: float
    w: Array
    d: Array


def fit_noise(
    model: ProcessModel,
    record: FilterRecord,
    smallest_sd: Sequence[float],
    learned: Sequence[str] = (),
    first_sd: Mapping[str, float] | None = None,
    nearby: Sequence[NoiseLevels] = (),
    *,
    apart: Sequence[NoiseLevels] = (),
    lacking: bool = False,
) -> NoiseFit:
    """Maximum-likelihood noise levels of a record, and positive parameters of the model.

    Args:
        model: model of the plant.
        record: the record, at increasing times; measurements that are missing or to be ignored are NaN.
        smallest_sd: lower bounds of the sensors' noise, one an output, in its unit; at least 1e-9 of the
            largest value: the logarithm of zero is undefined.
        learned: names of the parameters; the search starts at their values.
        first_sd: initial process noise by name of a state, where it differs from the noise that moves all states alike.
        nearby: further starts of the search, at most three, used where they are likelier than the first rows' result.
        apart: starts from the likeliest of which there is a search of its own, for another explanation of the record.
        lacking: whether the model may lack an effect that sets in later and then passes for process noise, so that the
            search also starts from noisier processes. Else a temporary disturbance is not learned as noise.
    """
    smallest = np.asarray(smallest_sd, dtype=float)
    return _NoiseSearch(model, record, smallest, learned, first_sd or {}).run(nearby, apart, lacking)


def losses_nearby(
    model: ProcessModel, record: FilterRecord, smallest_sd: Sequence[float], levels: Sequence[NoiseLevels]
) -> list[float]:
    """Losses of `fit_noise` at some noise levels; arguments as there."""
    search = _NoiseSearch(model, record, np.asarray(smallest_sd, dtype=float), (), {})
    search.use_rows(record.time_min.size)
    return [trial.loss for trial in search.evaluate([search.with_noise(item) for item in levels])]


class NoiseStarts(NamedTuple):
    """Noise levels from which a search should start, too; arguments `nearby` and `apart` of `fit_noise`."""

    nearby: list[NoiseLevels]
    apart: list[NoiseLevels]


def noise_starts(model: ProcessModel, measured: Array, smallest_sd: Sequence[float]) -> NoiseStarts:
    """Noise levels from which a search should start, too.

    All noise is coloured noise, and inputs that wander are all that moves the states, where the model has such.

    Args:
        model: the model with the states that `widen_model` has added.
        measured: measurements, shape (rows, n_y); NaN where missing.
        smallest_sd: lower bounds of the sensors' noise.
    """
    sds = np.maximum([initial_sensor_sd(column) for column in measured.T], smallest_sd).tolist()
    sensors, memory, rounding, wander = list(sds), *np.zeros((3, len(model.states)))
    for index, state in enumerate(model.states):
        name, kind = state.name.rpartition(".")[::2]
        if kind == "memory" and name in model.output_names:
            output = model.output_names.index(name)
            coarse, sd = is_coarse(measured[:, output]), sds[output]
            sensors[output] = (0.6 if coarse else 0.3) * sd
            if coarse:
                rounding[index] = 0.8 * sd * sqrt(2.0 / model.parameter(f"{state.name}_min").value)
            else:  # third differences see little of coloured noise
                memory[index] = 2.0 * sd
        elif kind == "wander" and name in model.input_names:
            wander[index] = state.scale * sqrt(2.0 / model.parameter(f"{state.name}_min").value)

    def levels(of_states: Array) -> NoiseLevels:
        return NoiseLevels(tuple(sensors), tuple(of_states.tolist()))

    nearby = [levels(rounding + size * memory) for size in (1.0, 3.0, 10.0)] if memory.any() else []
    shares = (0.03, 0.1, 0.3, 1.0) if wander.any() else (0.0,) if rounding.any() else ()
    return NoiseStarts(nearby, [levels(rounding + memory + share * wander) for share in shares])


class _NoiseSearch:
    """Search for the noise levels of one record."""

    def __init__(
        self,
        model: ProcessModel,
        record: FilterRecord,
        smallest_sd: Array,
        learned: Sequence[str],
        first_sd: Mapping[str, float],
    ) -> None:
        self._full, measured = record, record.measured
        self.use_rows(FIRST_ROWS)
        self._n_y = len(model.outputs)
        self._states = [i for i in range(len(model.states)) if i not in model.constant_states]
        self._of_states = range(self._n_y, self._n_y + len(self._states))
        self._scales = np.array([model.states[i].scale for i in self._states])
        names = [model.states[i].name for i in self._states]
        self._first_sd = np.array([first_sd.get(name, 0.0) for name in names])
        self._learned = [model.parameter(name) for name in learned]
        largest = np.max(np.abs(np.nan_to_num(measured)), axis=0)
        smallest_sd = np.maximum(smallest_sd, 1e-9 * np.where(largest > 0.0, largest, 1.0))
        limits = np.log([[item.lower, item.upper] for item in self._learned]).reshape(-1, 2).T
        # 1e-5 scales of process noise are as good as none.
        self._lowest = np.concatenate([np.log(smallest_sd), np.log(1e-5 * self._scales), limits[0]])
        self._highest = np.concatenate([np.full(self._of_states.stop, inf), limits[1]])
        self._first = np.maximum([initial_sensor_sd(column) for column in measured.T], smallest_sd)
        first = NoiseLevels(tuple(self._first.tolist()), (0.0,) * len(model.states))
        one = Filter(model, first)
        self._filters = [one, *(one.clone() for _ in range(LANES - 1))]

    def run(self, nearby: Sequence[NoiseLevels], apart: Sequence[NoiseLevels], lacking: bool) -> NoiseFit:
        """Best noise levels and parameter values."""
        best = self._climb(self._drop_outliers(self._start()))
        rows = self._full.time_min.size
        if rows > FIRST_ROWS:
            self.use_rows(rows)
            starts = [best.theta, *(self.with_noise(levels) for levels in nearby)]
            starts += self._noisier_starts(best.theta) if lacking else []
            best = min(self.evaluate(starts[:LANES]), key=lambda trial: trial.loss)
            best = self._climb(self._drop_outliers(best))
        if apart:  # only what these starts move is moved
            tried = self.evaluate([self.with_noise(levels) for levels in apart])
            other = min(tried, key=lambda trial: trial.loss)
            silent = {self._n_y + k for k, index in enumerate(self._states) if not apart[0].process_sd[index]}
            other = self._climb(other, [index for index in range(other.theta.size) if index not in silent])
            best = min(best, other, key=lambda trial: trial.loss)
        climbed = best
        for index in self._of_states:
            theta = best.theta.copy()
            theta[index] = self._lowest[index]
            (without,) = self.evaluate([theta])
            if without.loss < best.loss + 2.0:  # as by Akaike's criterion
                best = without
        if best is not climbed:  # the sensors' noise now has to account for more
            best, _ = self._step(best, range(self._n_y))
        return NoiseFit(self._levels(best.theta), self._changes(best.theta), best.loss, best.w)

    def with_noise(self, levels: NoiseLevels) -> Array:
        """Theta of these levels, with noise in every state: no step leads out of none."""
        sensors = np.maximum(np.log(levels.measurement_sd), self._lowest[: self._n_y])
        # 3e-4 scales of noise are negligible, but steps can start from them.
        states = np.maximum(np.array(levels.process_sd)[self._states], 3e-4 * self._scales)
        return np.concatenate([sensors, np.log(states), np.log([item.value for item in self._learned])])

    def _noisier_starts(self, theta: Array) -> list[Array]:
        """Copies of theta with process noises that move every state alike."""
        starts = [theta.copy() for _ in INITIAL_SHARES]
        for item, share in zip(starts, INITIAL_SHARES, strict=True):
            item[self._of_states] = np.where(self._first_sd > 0.0, item[self._of_states], np.log(share * self._scales))
        return starts

    def use_rows(self, rows: int) -> None:
        """Use the first rows of the record from here on."""
        full, first = self._full, slice(rows)
        uncertainty = None if full.uncertainty is None else full.uncertainty.select(first)
        self._record = FilterRecord(
            full.time_min[first], full.inputs[first], full.measured[first], GATE, uncertainty=uncertainty
        )

    def _drop_outliers(self, best: _Trial) -> _Trial:
        """Drop outliers: that of one sensor enters the normalised innovations of all."""
        record = self._record
        (run,) = self._run_filters([best.theta])
        with np.errstate(invalid="ignore"):
            measured = np.where(np.abs(run.residual) > GATE * run.sd, np.nan, record.measured)
        self._record = FilterRecord(record.time_min, record.inputs, measured, GATE, uncertainty=record.uncertainty)
        return self.evaluate([best.theta])[0]

    def _climb(self, best: _Trial, chosen: Sequence[int] | None = None) -> _Trial:
        """Take scoring steps in the chosen components of theta, or all, up to convergence."""
        for _ in range(8):
            before = best.loss
            best, predicted = self._step(best, range(best.theta.size) if chosen is None else chosen)
            gain = before - best.loss
            # A gain as predicted means that the loss is quadratic here, so the optimum is reached.
            if gain < 0.2 or abs(gain - predicted) < 0.1:  # of log likelihood
                break
        return best

    def _start(self) -> _Trial:
        """Best of the noises that move every state alike."""
        sensors, tried = np.log(self._first), list[_Trial]()
        others = np.log([item.value for item in self._learned])
        for share in INITIAL_SHARES:
            states = np.where(self._first_sd > 0.0, self._first_sd, share * self._scales)
            (trial,) = self.evaluate([np.concatenate([sensors, np.log(states), others])])
            inside = (trial.w != 0.0) & (np.abs(trial.w) < CLIP)
            mean_square = np.sum(trial.w**2 * inside, axis=0) / np.maximum(np.sum(inside, axis=0), 1)
            sensors = sensors + 0.5 * np.log(np.maximum(mean_square, 1e-6))
            sensors = np.maximum(sensors, self._lowest[: self._n_y])
            tried.append(trial)
        return min(tried, key=lambda trial: trial.loss)

    def _step(self, best: _Trial, chosen: Sequence[int]) -> tuple[_Trial, float]:
        """Take a scoring step in the chosen components of theta; returns `best` if none is better.

        Also returns the predicted gain, -inf for a shortened step, which predicts nothing about what is beyond.
        """
        largest = 1.2  # of a logarithm: sizes change by at most a factor of 3.3
        small = 0.01  # of a logarithm, for derivatives
        near = self.evaluate([best.theta + small * (np.arange(best.theta.size) == index) for index in chosen])
        of_w = np.stack([(trial.w - best.w) / small for trial in near])
        of_d = np.stack([(trial.d - best.d) / small for trial in near])
        counted = np.where(np.abs(best.w) < CLIP, 1.0 / _CUT_MEAN_SQUARE, 0.0)
        gradient = np.sum(of_d + of_w * best.w * counted, axis=(1, 2))
        of_w, of_d = (of_w * np.sqrt(counted)).reshape(len(chosen), -1), of_d.reshape(len(chosen), -1)
        information = of_w @ of_w.T + of_d @ of_d.T
        free = (best.theta[chosen] > self._lowest[chosen]) | (gradient < 0.0)
        gradient[~free], information[~free], information[:, ~free] = 0.0, 0.0, 0.0
        step = np.zeros(best.theta.size)
        step[chosen] = -np.linalg.solve(information + np.diag(1e-3 * np.diag(information) + 1.0), gradient)
        longest = float(np.max(np.abs(step)))
        full = longest <= largest
        step *= min(1.0, largest / max(longest, largest))
        for _ in range(4):
            predicted = -float(step[chosen] @ (gradient + 0.5 * information @ step[chosen]))
            if predicted < 0.02:
                break
            (trial,) = self.evaluate([np.clip(best.theta + step, self._lowest, self._highest)])
            if trial.loss < best.loss:
                return trial, predicted if full else -inf
            step, full = 0.4 * step, False
        return best, 0.0

    def _levels(self, theta: Array) -> NoiseLevels:
        sds, of_states = np.exp(theta), np.zeros(len(self._filters[0].model.states))
        own = slice(self._of_states.start, self._of_states.stop)
        of_states[self._states] = sds[own] * (theta[own] > self._lowest[own])
        return NoiseLevels(tuple(sds[: self._n_y].tolist()), tuple(of_states.tolist()))

    def _changes(self, theta: Array) -> dict[str, float]:
        values = np.exp(theta[self._of_states.stop :]).tolist()
        return {
            item.name: min(max(value, item.lower), item.upper)
            for item, value in zip(self._learned, values, strict=True)
        }

    def _run_filters(self, thetas: Sequence[Array]) -> list[FilterResult]:
        """Filter the record with each theta, as many at once as there are filters."""
        results: list[FilterResult] = []
        for begin in range(0, len(thetas), len(self._filters)):
            runs = []
            for item, theta in zip(self._filters, thetas[begin:], strict=False):
                item.noise = self._levels(theta)
                if self._learned:
                    item.set_parameters(self._changes(theta))
                runs.append(item.run_batched(self._record))
            results += run_together(runs)
        return results

    def evaluate(self, thetas: Sequence[Array]) -> list[_Trial]:
        """Evaluate the loss at each theta."""
        return [self._trial(theta, run) for theta, run in zip(thetas, self._run_filters(thetas), strict=True)]

    def _trial(self, theta: Array, run: FilterResult) -> _Trial:
        w, sd = run.normalized[20:], run.conditional_sd[20:]  # the filter has converged
        known = np.isfinite(w)
        w, d = np.where(known, w, 0.0), np.log(np.where(known, sd, 1.0))
        loss = float(np.sum(d) + 0.5 * np.sum(np.minimum(w**2, CLIP**2)) / _CUT_MEAN_SQUARE)
        return _Trial(theta, loss if np.isfinite(loss) else inf, w, d)


def initial_sensor_sd(column: Array) -> float:
    """A first estimate of a sensor's noise, from third differences; 0 where there are too few values.

    Third differences remove most of the process's movement, and their median most outliers.

    Args:
        column: measurements, shape (rows,); NaN where missing.
    """
    third = np.abs(np.diff(column[np.isfinite(column)], n=3))
    # The median size of third differences of white noise of unit variance.
    return float(np.median(third)) / (0.6745 * sqrt(20.0)) if third.size else 0.0


def resolution(values: Array) -> float:
    """Smallest step between two values; 0 if there is none.

    A signal of n values without steps has neighbours about 1 / n^2 of its range apart, which is as good as none.

    >>> round(resolution(np.array([1.2, 0.9, 0.3, 0.3 + 1e-16])), 9)
    0.3

    Args:
        values: values of the signal, shape (n,); NaN where missing.
    """
    levels = np.unique(values[np.isfinite(values)])
    steps = np.diff(levels)
    steps = steps[steps > 1e-12 * np.max(np.abs(levels), initial=0.0)]  # less is a rounding error
    return float(steps.min()) if steps.size else 0.0


def is_coarse(values: Array) -> bool:
    """True if a signal's rounding errors have memory, as its noise is less than half its step.

    The errors of a signal that is rounded to steps of q are white if noise of a standard deviation of q / 2 or more
    is added to it before: the correlation left is less than exp(-pi^2) of their variance (Widrow & Kollar 2008,
    Quantization noise). Noise and errors together then have q / sqrt(3), and third differences show it.

    Args:
        values: values of the signal, shape (n,); NaN where missing.
    """
    return initial_sensor_sd(values) < resolution(values) / sqrt(3.0)


def resolution_sd(values: Array, stated: float | None = None) -> float:
    """Standard deviation of a signal's residual due to its steps alone.

    A sensor with steps of q has an error of up to q / 2. If uniform in that range, it has the standard deviation
    q / sqrt(12) (Sheppard 1898, On the calculation of the most probable values of frequency-constants for data arranged
    according to equidistant divisions of a scale, Proc. London Math. Soc. 29). Residuals of the sensor are no smaller.

    Args:
        values: values of the signal, shape (n,); NaN where missing.
        stated: resolution of the signal; None: it is learned.
    """
    return (resolution(values) if stated is None else stated) / sqrt(12.0)
