"""Recursive identification of output-error, ARMAX and Box-Jenkins models.

The recursive prediction error method (Ljung and Soderstrom, Theory and Practice of Recursive Identification, 1983,
chapter 3, with the projection of chapter 6). The models, a plant w and its disturbance v,
are those of `linear_predictor`. The parameters p follow the gradient g of the prediction, from the same recursions
differentiated,

    p <- p + P g (y[k] - yhat[k]),

with P the weighted least squares covariance of the g, as `RecursiveLeastSquares` keeps it: a row g with the output
y - yhat + g' p. So its memory is bounded as there. w, v and e in memory are computed with the new parameters, which
converges better than with the old ones (the same, chapter 5).

Three things keep it stable. A step that would put a pole, or a zero of the disturbance, on or outside the unit circle
is halved until it doesn't. The first rows count little: forgetting starts at 0.95 and rises, f <- 0.99 f + 0.01 (the
same, chapter 5), because the first gradients belong to poor parameters. And after a gap the run restarts from measured
rows (`restart`).
"""

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.arrays import Array
from reactorwatch.identification.batch import solution_of, unscale
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.linear_predictor import Kind, LinearPredictor
from reactorwatch.identification.rls import RecursiveLeastSquares, RlsUpdate
from reactorwatch.identification.structure import Scaling, Structure

START_FORGETTING = 0.95
FORGETTING_RISE = 0.99
COVARIANCE_LIMIT = 1e4
"""See `RecursiveLeastSquares`; also how far from zero the parameters may be."""
_HALVINGS = 40


class RecursivePredictionError:
    """Predicts an output, and corrects its parameters by each measured row.

    Args:
        structure: terms of the plant, with an offset for `armax` and `bj`.
        scaling: scaling of the signals; without it they are taken as they are, which suits signals of the order of 1.
        forgetting: weight of a row relative to its successor, in (0, 1], once it has risen to it.
        kind: `oe` (output error), `armax` or `bj` (Box-Jenkins).

    Raises:
        InputError: a Box-Jenkins model without inputs, or a setting out of its range.
    """

    def __init__(
        self,
        structure: Structure,
        scaling: Scaling | None = None,
        forgetting: float = 1.0,
        kind: Kind = "oe",
    ) -> None:
        self._structure, self._kind = structure, kind
        self._scaling = Scaling.none(structure.inputs) if scaling is None else scaling
        self._forgetting = forgetting
        self._predictor = LinearPredictor(kind, structure)
        self._estimator = RecursiveLeastSquares(
            self._predictor.size, min(START_FORGETTING, forgetting), COVARIANCE_LIMIT
        )
        self.restart()

    def restart(self) -> None:
        """Clear the run, as after a gap in the rows; keep the parameters."""
        history, plant, noise_lags = self._structure.history, self._structure.parameters, self._predictor.noise_lags
        self._filled = 0
        self._own = np.zeros(history)
        self._inputs = np.zeros((history, self._structure.inputs))
        self._plant_gradients = np.zeros((history, plant))
        self._disturbance = np.zeros(noise_lags)
        self._errors = np.zeros(noise_lags)
        self._gradients = np.zeros((noise_lags, self._predictor.index.size))

    def update(self, inputs: ArrayLike, output: float) -> RlsUpdate | None:
        """Predict the output, then learn from its measurement.

        Args:
            inputs: shape (inputs,), of the same row as the output.
            output: the measured output.

        Returns:
            The innovation, in the output's unit; None while the first rows are taken from measurements.

        Raises:
            ValueError: a value that is NaN, infinite or beyond 1e30, or a wrong shape; nothing is changed then.
        """
        new_inputs = self._scaling.inputs(inputs)
        measured = float(self._scaling.outputs([output])[0])
        if new_inputs.shape != self._inputs.shape[1:] or not np.all(np.isfinite([*new_inputs, measured])):
            raise ValueError(
                f"a row must have {self._structure.inputs} finite inputs and a finite output, "
                f"got {inputs!r} and {output!r}: restart() after a gap"
            )
        if self._filled < self._structure.history:
            _push(self._own, measured)
            _push(self._inputs, new_inputs)
            self._filled += 1
            return None
        regressor = self._regressor()
        old = self._estimator.parameters
        (plant, d, c), predictor = self._predictor.split(old), self._predictor
        prediction = float(regressor @ plant + d @ self._disturbance + c @ self._errors)
        lags = self._structure.output_lags
        of_plant = regressor + plant[:lags] @ self._plant_gradients[:lags]
        through_noise = of_plant - d @ self._plant_gradients[: predictor.noise_lags]
        full = np.concatenate([through_noise, self._disturbance, self._errors])[: predictor.index.size]
        full -= c @ self._gradients
        gradient = np.bincount(predictor.index, weights=full)
        result = self._estimator.update(gradient, measured - prediction + float(gradient @ old))
        plant, d, c = predictor.split(self._project(old))
        if self._estimator.forgetting < self._forgetting:
            risen = FORGETTING_RISE * self._estimator.forgetting + (1.0 - FORGETTING_RISE)
            self._estimator.raise_forgetting(min(risen, self._forgetting))
        own = float(regressor @ plant)
        error = measured - own - float(d @ self._disturbance + c @ self._errors)
        _push(self._own, own)
        _push(self._inputs, new_inputs)
        _push(self._plant_gradients, of_plant)
        _push(self._disturbance, measured - own)
        _push(self._errors, error)
        _push(self._gradients, full)
        centre, spread = self._scaling.output_centres[0], self._scaling.output_spreads[0]
        return RlsUpdate(
            prediction * spread + centre,
            (measured - prediction) * spread,
            result.residual_sd * spread,
            result.leverage,
        )

    @property
    def model(self) -> LinearModel:
        """The learned model, in the signals' own units."""
        return unscale(self._kind, self._structure, self._scaling, solution_of(self._estimator))

    def _regressor(self) -> Array:
        structure = self._structure
        first = structure.delay - 1
        parts = [self._own[: structure.output_lags], self._inputs[first : first + structure.input_lags].ravel()]
        return np.concatenate([*parts, [1.0]] if structure.offset else parts)

    def _project(self, old: Array) -> Array:
        """Halve the step that was made from `old` until poles and zeros are inside the unit circle."""
        new = self._estimator.parameters
        if self._predictor.is_stable(new):
            return new
        step = new - old
        for _ in range(_HALVINGS):
            step = 0.5 * step
            if self._predictor.is_stable(old + step):
                break
        else:
            step = np.zeros_like(old)
        self._estimator.set_parameters(old + step)
        return self._estimator.parameters


def _push(memory: Array, value: ArrayLike) -> None:
    """Make a value the newest of a memory, whose oldest is dropped."""
    memory[1:] = memory[:-1]
    memory[:1] = value
