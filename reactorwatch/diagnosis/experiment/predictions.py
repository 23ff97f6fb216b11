"""Predictions of alternative explanations for a new input, and how well each could imitate those of another.

The causes stay in the plant: each keeps its magnitude at the end of the record, and a sine continues. So each
alternative predicts the outputs for an input that has not been tried.

Assume alternative i is true. The evidence against alternative j is not the difference of the two predictions but the
part that j cannot imitate with other parameters (Atkinson & Fedorov 1975, The design of experiments for discriminating
between two rival models, Biometrika 62; Hunter & Reiner 1965, Designs for discriminating between two rival models,
Technometrics 7). It is computed as in the diagnosis: the filter of j runs over the noise-free prediction of i. With w
its normalised innovations, g their derivatives by the parameters of j and L the prior information on these parameters,

    lambda = w'w - w'g (g'g + L)^-1 g'w

is the noncentrality of the likelihood ratio test of j: with noise, twice the log likelihood ratio is on average lambda,
up to the number of fitted parameters, and its standard deviation is 2 sqrt(lambda). The filter has the process noise,
so evidence that this noise would hide does not count. L contains only the parameters' bounds and not the present
record: the record of the experiment has to decide by itself, also if the cause has changed in the meantime. Evaluated
together with the present record it says no less.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from math import sqrt

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.experiment.inputs import InputRange, Limits, keeps_limits, limits_of
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, FittedProfile, LateSine, Sine
from reactorwatch.diagnosis.fitting.scan import fit_hypothesis
from reactorwatch.diagnosis.result import LISTED
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import SimulationError, Simulator, Trajectory

REFINED_STEPS = 1
"""Steps of a fit: the first takes the linear solution to the nonlinear equations."""

LARGEST_SHARE = 0.5
"""Fraction of the pattern's time: a sine with a longer period is taken as constant."""

MARGIN_SD = 3.0
"""Margin of an output to its limits, in standard deviations of its noise, so that the measurements keep them."""

REST_ROWS = 300


class Prediction:
    """A fitted explanation, extrapolated beyond the end of its record.

    Attributes:
        causes: names of its effects.
        label: labels of its effects.
        n_parameters: number of parameters fitted to a record of the experiment.
        start_min: start of the experiment.

    Args:
        hypothesis: hypothesis at the present noise levels.
        fit: fit of the hypothesis.
        run: the record.
        resting: inputs at which the plant settles before the experiment, shape (n_u,).
        rest_rows: number of rows for settling.
        pattern_min: length of the pattern; only sines of shorter periods are extrapolated as sines.
    """

    def __init__(
        self, hypothesis: Hypothesis, fit: Fit, run: Run, resting: Array, rest_rows: int, pattern_min: float
    ) -> None:
        self.causes = hypothesis.causes
        self.label = " with ".join(
            effect.labels.get(profile.name, effect.label)
            for effect, profile in zip(hypothesis.filter.effects, hypothesis.profiles, strict=True)
        )
        self._hypothesis, self._fit, self._pattern_min = hypothesis, fit, pattern_min
        self._simulator = Simulator(hypothesis.filter.full_model.model)
        time_min: Array = float(run.time_min[-1]) + run.period_min * np.arange(rest_rows + 1, dtype=np.float64)
        self.start_min = float(time_min[-1])
        self.n_parameters = self._extrapolate(time_min)[0].n_parameters
        finite = np.flatnonzero(np.all(np.isfinite(fit.innovations.x), axis=1))
        start = fit.innovations.x[finite[-1], : hypothesis.filter.n_plant_states]
        rested = self._run(time_min, np.tile(resting, (time_min.size, 1)), start)
        self._start = None if rested is None else rested.states[-1]

    @property
    def name(self) -> str:
        """Names of its causes, joined by a plus."""
        return "+".join(self.causes)

    def predict_outputs(self, time_min: Array, inputs: Array) -> Array | None:
        """Noise-free outputs from rest, shape (rows, n_y); None if the simulation diverges.

        Args:
            time_min: times of the rows, after the record's end, shape (rows,).
            inputs: shape (rows, n_u).
        """
        result = None if self._start is None else self._run(time_min, inputs, self._start)
        return None if result is None else result.outputs

    def noncentrality(self, truth: Run) -> float:
        """Noncentrality (lambda in the module) of a run that another alternative predicts."""
        hypothesis, parameters = self._extrapolate(truth.time_min)
        return hypothesis.unexplained_sum(truth, hypothesis.evaluate(truth, parameters))

    def own_loss(self, run: Run) -> float:
        """Negative log likelihood of its own prediction."""
        hypothesis, parameters = self._extrapolate(run.time_min)
        return hypothesis.evaluate(run, parameters).loss

    def loss(self, run: Run) -> float:
        """Negative log likelihood of another's prediction, at its best fit."""
        hypothesis, parameters = self._extrapolate(run.time_min)
        return fit_hypothesis(run, hypothesis, parameters, REFINED_STEPS).loss

    def _extrapolate(self, time_min: Array) -> tuple[Hypothesis, list[Array]]:
        profiles, values = [], []
        for profile, parameters in zip(self._hypothesis.profiles, self._fit.parameters, strict=True):
            later, then = extrapolate(profile, parameters, time_min, self._pattern_min)
            profiles.append(later)
            values.append(np.append(then, parameters[profile.n_shape :]))
        return Hypothesis(self._hypothesis.filter, profiles), values

    def _run(self, time_min: Array, inputs: Array, start: Array) -> Trajectory | None:
        hypothesis, parameters = self._extrapolate(time_min)
        signals = hypothesis.signals_at(parameters)
        try:
            return self._simulator.run(time_min, hypothesis.filter.full_model.inputs(time_min, inputs, signals), start)
        except SimulationError:
            return None


class Predictions:
    """Explanations of one record, extrapolated with other levels of an input.

    Args:
        hypotheses: hypotheses fitted to the record.
        run: the record.
        model: process model without their causes.
        noise: noise levels of the plant and its sensors.
        given: limits by signal; for the others see `limits_of`.
        pattern_rows: rows of the pattern, see `Prediction`.

    Attributes:
        pairs: indices of every two of them.
        limits: limits of every signal.
        rest: level of each input at which the plant settles before, about its median in the record, shape (n_u,).
        period_min: sampling period.
    """

    def __init__(
        self,
        hypotheses: Sequence[FittedHypothesis],
        run: Run,
        model: ProcessModel,
        noise: Noise,
        given: Mapping[str, tuple[float, float]],
        pattern_rows: int,
    ) -> None:
        self._outputs = model.output_names
        self._margin = MARGIN_SD * noise.sensor_sd(model.output_names)
        self.limits: Limits = limits_of(run, model, given)
        self.period_min = run.period_min
        self.rest = np.array(
            [
                InputRange(low, high, min(max(float(usual), low), high)).levels(np.zeros(1))[0]
                for usual, (low, high) in zip(
                    np.median(run.inputs, axis=0), (self.limits[name] for name in model.input_names), strict=True
                )
            ]
        )
        for item in hypotheses:
            item.hypothesis.filter.noise = noise
        pattern_min = pattern_rows * self.period_min
        self.members = tuple(
            Prediction(item.hypothesis, item.fit, run, self.rest, REST_ROWS, pattern_min) for item in hypotheses
        )
        self.pairs = list(combinations(range(len(self.members)), 2))

    def runs(self, levels: Array, moved: int = 0) -> list[Run] | None:
        """Noise-free records that each predicts; None if an output of any leaves its limits.

        Args:
            levels: levels of the input that is moved, shape (rows,).
            moved: index of the input that is moved.
        """
        time_min = self.members[0].start_min + self.period_min * np.arange(levels.size, dtype=np.float64)
        inputs = np.tile(self.rest, (levels.size, 1))
        inputs[:, moved] = levels
        result = []
        for alternative in self.members:
            outputs = alternative.predict_outputs(time_min, inputs)
            if outputs is None or not keeps_limits(outputs, self.limits, self._outputs, self._margin):
                return None
            result.append(Run(time_min, inputs, outputs))
        return result

    def noncentralities(self, runs: Sequence[Run]) -> dict[tuple[int, int], float]:
        """Twice the log likelihood ratio of each, if true, over each other, without noise.

        Unlike `Prediction.noncentrality` it comes from fits, so it contains the nonlinearity of the equations.
        """
        result = {}
        for true, run in enumerate(runs):
            own = self.members[true].own_loss(run)
            for other, alternative in enumerate(self.members):
                if other != true:
                    result[true, other] = max(2.0 * (alternative.loss(run) - own), 0.0)
        return result


def extrapolate(
    profile: FittedProfile, parameters: Array, time_min: Array, pattern_min: float
) -> tuple[FittedProfile, Array]:
    """Extrapolate a deviation beyond the record: its profile and parameters.

    Args:
        profile: profile in the record.
        parameters: parameters of the alternative at that time.
        time_min: times of the new rows, shape (rows,).
        pattern_min: see `Prediction`.
    """
    if isinstance(profile, Sine) and parameters[2] <= LARGEST_SHARE * pattern_min:
        zero_min = parameters[3] if isinstance(profile, LateSine) else profile.start_min
        angle = 2.0 * np.pi / parameters[2] * (float(time_min[0]) - zero_min)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return Sine(time_min), np.append(turn @ parameters[:2], parameters[2:3])
    return Constant(time_min), profile.signal(parameters).sample_value[-1:]


def decision_probability(expected: float, evidence: float) -> float:
    """Probability that the difference in BIC exceeds `LISTED`.

    Args:
        expected: expected difference in BIC.
        evidence: noncentrality of the evidence.

    >>> round(decision_probability(30.0, 30.0), 3)
    0.966
    """
    return float(special.ndtr((expected - LISTED) / max(2.0 * sqrt(evidence), 1e-9)))
