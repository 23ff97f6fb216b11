"""How noisy a process and its sensors are, learned from a record of a time when all was well.

The filter's gain follows from two kinds of noise: that of the sensors, and that of the process, which stands for all
that moves the state and is not in the model. Both are chosen by the likelihood of the innovations (Schweppe 1965,
Evaluation of likelihood functions for Gaussian signals, IEEE Trans. Information Theory 11). It is climbed by scoring
(Gupta & Mehra 1974, Computational aspects of maximum likelihood estimation and reduction in sensitivity function
calculations, IEEE Trans. Automatic Control 19): with theta the logarithms of all standard deviations, w the whitened
innovations and d the logarithms of what they were divided by, differences of a few runs of the filter give

    gradient = sum(d' + w w'),    information = sum(w'^2 + d'^2),    step = -gradient / information,

and steps are shortened until they gain. The search begins with a process noise that moves every state alike, the best
of a few; the sensors' noise there is what makes the mean square of the innovations what the filter expects. In the end
a state whose noise the record does not need has none: a plant that the model describes perfectly is described so.

States that never change (`ProcessModel.lasting`) have no noise. Other numbers that the likelihood depends on, such as
how long the noise of a sensor remembers, are learned likewise, if they are parameters of the model: their logarithms
are further components of theta.

Outliers do not pass for noise: those beyond `GATE` standard deviations are left out, and beyond `CLIP` it does not
matter how far off a value is. So as not to take the tails of normal noise for outliers, squares are compared with those
of normal values that are cut off likewise (Huber 1981, Robust Statistics, ch. 5).
"""

from collections.abc import Mapping, Sequence
from math import erf, exp, inf, pi, sqrt
from typing import NamedTuple

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES
from reactorwatch.kalman.batch_runner import together
from reactorwatch.kalman.ekf import Filter, NoiseLevels
from reactorwatch.kalman.filter_record import FilterRecord
from reactorwatch.kalman.innovations import Innovations
from reactorwatch.kalman.input_uncertainty import Doubt
from reactorwatch.process.model import ProcessModel

SHARES = (0.3, 0.03, 0.003)
"""Process noise to begin with, in scales of the state per square root of a minute; the noisiest finds its way best."""

LEAST_RELATIVE_SD = 1e-9
"""Of a sensor, relative to the largest value that it shows: the logarithm of no noise at all cannot be taken."""

LEAST_SHARE, AS_GOOD_AS_NONE = 1e-5, 3e-4
"""Less is none; and so little that it is as good as none, though steps lead out of it."""

CLIP = 4.0
"""Standard deviations beyond which it does not matter how far off a value is."""

GATE = 6.0
FIRST_ROWS = 300
"""The search goes its first steps on so many rows alone."""

MOST_STEPS, MOST_CUTS = 8, 4
LONGEST_STEP = 1.2
"""Of a logarithm."""

DIFFERENCE = 0.01
"""Of a logarithm, for the derivatives."""

SETTLED = 0.2
"""In log likelihood: a smaller gain ends the search."""

LEAST_PROMISED = 0.02
"""In log likelihood: a step that promises less is not tried."""

LEAST_GAIN = 2.0
"""In log likelihood: less does not make a plant noisy."""

BURN_IN = 20
"""Rows at the start in which the filter still finds its state."""

_CUT, _RIDGE = 0.4, 1e-3
_OF_THIRD_DIFFERENCES = 0.6745 * sqrt(20.0)  # their median size, for white noise of unit variance
_CUT_MEAN_SQUARE = erf(CLIP / sqrt(2)) - CLIP * sqrt(2 / pi) * exp(-(CLIP**2) / 2)  # of w where |w| < CLIP, else 0


class _Trial(NamedTuple):
    """The logarithms of some noise levels, and what they make of the record.

    Attributes:
        theta: the sensors' first, then those of the states that change, then those of further numbers.
        loss: minus the log likelihood.
        w: the whitened innovations, shape (rows, n_y); 0 where there are none.
        d: logarithms of what the innovations were divided by to be so, likewise.
    """

    theta: Array
    loss: float
    w: Array
    d: Array


def tune(
    model: ProcessModel, time_min: Array, inputs: Array, measured: Array, smallest_sd: Sequence[float]
) -> NoiseLevels:
    """The noise levels under which a record is likeliest.

    Args:
        model: of the plant.
        time_min: shape (rows,), increasing.
        inputs: shape (rows,) or (rows, n_u).
        measured: shape (rows, n_y); NaN where missing or not to be learned from.
        smallest_sd: of the sensors, one an output, in its unit: theirs are at least so large, and at least
            `LEAST_RELATIVE_SD` of what they show.
    """
    return tune_with(model, time_min, inputs, measured, smallest_sd, (), {})[0]


def tune_with(
    model: ProcessModel,
    time_min: Array,
    inputs: Array,
    measured: Array,
    smallest_sd: Sequence[float],
    learned: Sequence[str],
    first_sd: Mapping[str, float],
    doubt: Doubt | None = None,
    nearby: Sequence[NoiseLevels] = (),
    *,
    lacking: bool = False,
) -> tuple[NoiseLevels, dict[str, float]]:
    """The noise levels, and positive parameters of the model, under which a record is likeliest.

    Args:
        model: see `tune`, as for the next four.
        time_min: likewise.
        inputs: likewise.
        measured: likewise.
        smallest_sd: likewise.
        learned: names of the parameters; the search begins at their values.
        first_sd: by name of a state, its process noise to begin with, where it is not one of those that move alike.
        doubt: ways on which nobody knows when inputs changed; None: there are none.
        nearby: noise levels that may be near, at most three; where some are likelier than what the first rows say, the
            search begins there.
        lacking: whether the model may lack something that acts later on, which then passes for process noise, so that
            noisier processes are tried too. Else what disturbs a record for a while is not to be learned from it.
    """
    smallest = np.asarray(smallest_sd, dtype=float)
    return _Tuning(model, time_min, inputs, measured, smallest, learned, first_sd, doubt).found(nearby, lacking)


class _Tuning:
    """The search for the noise levels of one record."""

    def __init__(
        self,
        model: ProcessModel,
        time_min: Array,
        inputs: Array,
        measured: Array,
        smallest_sd: Array,
        learned: Sequence[str],
        first_sd: Mapping[str, float],
        doubt: Doubt | None,
    ) -> None:
        self._doubt = doubt
        self._whole, self._rows = (time_min, inputs, measured), time_min.size
        self._take(FIRST_ROWS)
        self._n_y = len(model.outputs)
        self._states = [place for place in range(len(model.states)) if place not in model.lasting]
        self._of_states = range(self._n_y, self._n_y + len(self._states))
        self._scales = np.array([model.states[place].scale for place in self._states])
        names = [model.states[place].name for place in self._states]
        self._apart = np.array([first_sd.get(name, 0.0) for name in names])
        self._learned = [model.parameter(name) for name in learned]
        largest = np.max(np.abs(np.nan_to_num(measured)), axis=0)
        smallest_sd = np.maximum(smallest_sd, LEAST_RELATIVE_SD * np.where(largest > 0.0, largest, 1.0))
        limits = np.log([[item.lower, item.upper] for item in self._learned]).reshape(-1, 2).T
        self._lowest = np.concatenate([np.log(smallest_sd), np.log(LEAST_SHARE * self._scales), limits[0]])
        self._highest = np.concatenate([np.full(self._of_states.stop, inf), limits[1]])
        self._first = np.maximum([rough_sensor_sd(column) for column in measured.T], smallest_sd)
        first = NoiseLevels(tuple(self._first.tolist()), (0.0,) * len(model.states))
        one = Filter(model, first)
        self._filters = [one, *(one.twin() for _ in range(LANES - 1))]

    def found(self, nearby: Sequence[NoiseLevels], lacking: bool) -> tuple[NoiseLevels, dict[str, float]]:
        """The best noise levels, and the best values of what else was to be learned."""
        best = self._climbed(self._without_outliers(self._begun()))
        if self._rows > FIRST_ROWS:
            self._take(self._rows)
            starts = [best.theta, *(self._near(levels) for levels in nearby)]
            starts += self._noisier(best.theta) if lacking else []
            best = min(self._tried(starts[:LANES]), key=lambda trial: trial.loss)
            best = self._climbed(self._without_outliers(best))
        climbed = best
        for index in self._of_states:
            theta = best.theta.copy()
            theta[index] = self._lowest[index]
            (without,) = self._tried([theta])
            if without.loss < best.loss + LEAST_GAIN:
                best = without
        if best is not climbed:  # the sensors now have to account for more
            best, _ = self._stepped(best, range(self._n_y))
        return self._levels(best.theta), self._changes(best.theta)

    def _near(self, levels: NoiseLevels) -> Array:
        """Theta there, with noise in every state: out of none no step leads."""
        sensors = np.maximum(np.log(levels.measurement_sd), self._lowest[: self._n_y])
        states = np.maximum(np.array(levels.process_sd)[self._states], AS_GOOD_AS_NONE * self._scales)
        return np.concatenate([sensors, np.log(states), np.log([item.value for item in self._learned])])

    def _noisier(self, theta: Array) -> list[Array]:
        """With a process noise that moves every state alike."""
        found = [theta.copy() for _ in SHARES]
        for item, share in zip(found, SHARES, strict=True):
            item[self._of_states] = np.where(self._apart > 0.0, item[self._of_states], np.log(share * self._scales))
        return found

    def _take(self, rows: int) -> None:
        """Go on with so many rows from the beginning."""
        time_min, inputs, measured = self._whole
        doubt = None if self._doubt is None else self._doubt.of_rows(slice(rows))
        self._record = FilterRecord.of(time_min[:rows], inputs[:rows], measured[:rows], GATE, doubt=doubt)

    def _without_outliers(self, best: _Trial) -> _Trial:
        """The same noise levels on the record without its outliers: an outlier of one sensor whitens into all."""
        record = self._record
        (run,) = self._runs([best.theta])
        with np.errstate(invalid="ignore"):
            measured = np.where(np.abs(run.residual) > GATE * run.sd, np.nan, record.measured)
        self._record = FilterRecord.of(record.time_min, record.inputs, measured, GATE, doubt=record.doubt)
        return self._tried([best.theta])[0]

    def _climbed(self, best: _Trial) -> _Trial:
        """The best that steps of scoring find."""
        for _ in range(MOST_STEPS):
            before = best.loss
            best, promised = self._stepped(best, range(best.theta.size))
            gained = before - best.loss
            # A step that gains what was promised leaves nothing to gain: all is as good as quadratic there.
            if gained < SETTLED or abs(gained - promised) < 0.5 * SETTLED:
                break
        return best

    def _begun(self) -> _Trial:
        """The best of those that move every state alike."""
        sensors, tried = np.log(self._first), list[_Trial]()
        others = np.log([item.value for item in self._learned])
        for share in SHARES:
            states = np.where(self._apart > 0.0, self._apart, share * self._scales)
            (trial,) = self._tried([np.concatenate([sensors, np.log(states), others])])
            inside = (trial.w != 0.0) & (np.abs(trial.w) < CLIP)
            mean_square = np.sum(trial.w**2 * inside, axis=0) / np.maximum(np.sum(inside, axis=0), 1)
            sensors = sensors + 0.5 * np.log(np.maximum(mean_square, 1e-6))
            sensors = np.maximum(sensors, self._lowest[: self._n_y])
            tried.append(trial)
        return min(tried, key=lambda trial: trial.loss)

    def _stepped(self, best: _Trial, chosen: range) -> tuple[_Trial, float]:
        """After a step of scoring in the chosen components of theta; `best` if none is better.

        And what the step promised; of one that was shortened nobody knows what is behind it, so none at all.
        """
        near = self._tried([best.theta + DIFFERENCE * (np.arange(best.theta.size) == index) for index in chosen])
        of_w = np.stack([(trial.w - best.w) / DIFFERENCE for trial in near])
        of_d = np.stack([(trial.d - best.d) / DIFFERENCE for trial in near])
        counted = np.where(np.abs(best.w) < CLIP, 1.0 / _CUT_MEAN_SQUARE, 0.0)
        gradient = np.sum(of_d + of_w * best.w * counted, axis=(1, 2))
        of_w, of_d = (of_w * np.sqrt(counted)).reshape(len(chosen), -1), of_d.reshape(len(chosen), -1)
        information = of_w @ of_w.T + of_d @ of_d.T
        free = (best.theta[chosen] > self._lowest[chosen]) | (gradient < 0.0)
        gradient[~free], information[~free], information[:, ~free] = 0.0, 0.0, 0.0
        step = np.zeros(best.theta.size)
        step[chosen] = -np.linalg.solve(information + np.diag(_RIDGE * np.diag(information) + 1.0), gradient)
        longest = float(np.max(np.abs(step)))
        whole = longest <= LONGEST_STEP
        step *= min(1.0, LONGEST_STEP / max(longest, LONGEST_STEP))
        for _ in range(MOST_CUTS):
            promised = -float(step[chosen] @ (gradient + 0.5 * information @ step[chosen]))
            if promised < LEAST_PROMISED:
                break
            (trial,) = self._tried([np.clip(best.theta + step, self._lowest, self._highest)])
            if trial.loss < best.loss:
                return trial, promised if whole else -inf
            step, whole = _CUT * step, False
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

    def _runs(self, thetas: Sequence[Array]) -> list[Innovations]:
        """What filters with these numbers say of the record, at most as many as there are filters at once."""
        found: list[Innovations] = []
        for begin in range(0, len(thetas), len(self._filters)):
            runs = []
            for item, theta in zip(self._filters, thetas[begin:], strict=False):
                item.noise = self._levels(theta)
                if self._learned:
                    item.change(self._changes(theta))
                runs.append(item.stretches(self._record))
            found += together(runs)
        return found

    def _tried(self, thetas: Sequence[Array]) -> list[_Trial]:
        """What some numbers make of the record."""
        return [self._judged(theta, run) for theta, run in zip(thetas, self._runs(thetas), strict=True)]

    def _judged(self, theta: Array, run: Innovations) -> _Trial:
        w, sd = run.whitened[BURN_IN:], run.conditional_sd[BURN_IN:]
        known = np.isfinite(w)
        w, d = np.where(known, w, 0.0), np.log(np.where(known, sd, 1.0))
        loss = float(np.sum(d) + 0.5 * np.sum(np.minimum(w**2, CLIP**2)) / _CUT_MEAN_SQUARE)
        return _Trial(theta, loss if np.isfinite(loss) else inf, w, d)


def rough_sensor_sd(column: Array) -> float:
    """A first guess of a sensor's noise; 0 where there are too few values.

    Third differences leave little of what the process does, and their median little of outliers.

    Args:
        column: what it measured, shape (rows,); NaN where missing.
    """
    third = np.abs(np.diff(column[np.isfinite(column)], n=3))
    return float(np.median(third)) / _OF_THIRD_DIFFERENCES if third.size else 0.0
