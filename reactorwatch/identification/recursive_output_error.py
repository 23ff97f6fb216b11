"""Recursive identification of output-error models.

The recursive prediction error method (Ljung and Soderstrom, Theory and Practice of Recursive Identification, 1983,
chapter 3, with the projection of chapter 6): the recursion runs on its own
output, and the parameters follow the gradient g of that run,

    yhat[k] = phi[k]' p,     g[k] = phi[k] + a1 g[k-1] + ... + an g[k-n],     p <- p + P g (y[k] - yhat[k]),

with P the weighted least squares covariance of the g, as `RecursiveLeastSquares` keeps it: a row g with the output
y - yhat + g' p. So its memory is bounded as there. phi holds the run computed with the new parameters, which converges
better than with the old ones (the same, chapter 5).

Three things keep it stable. A step that would put a pole on or outside the unit circle is halved until it doesn't. The
first rows count little: forgetting starts at 0.95 and rises, f <- 0.99 f + 0.01 (the same, chapter 5), because the
first gradients belong to poor parameters. And after a gap the run restarts from measured rows (`restart`).
"""

from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.errors import InputError
from reactorwatch.identification.batch import model_of
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.output_error import is_stable
from reactorwatch.identification.recursion import RlsState
from reactorwatch.identification.rls import RecursiveLeastSquares, RlsUpdate
from reactorwatch.identification.structure import Scaling, Structure
from reactorwatch.stored_state import StoredState

START_FORGETTING = 0.95
FORGETTING_RISE = 0.99
COVARIANCE_LIMIT = 1e4
"""See `RecursiveLeastSquares`; also how far from zero the parameters may be."""
_HALVINGS = 40


class RecursiveOutputErrorState(StoredState, frozen=True):
    """State of a `RecursiveOutputError`.

    Attributes:
        structure: the model's terms.
        scaling: scaling of the signals.
        forgetting: final forgetting factor.
        estimator: the parameters and their covariance.
        own: the simulation's newest outputs, newest first; fewer while the history fills.
        inputs: newest inputs, newest first.
        gradients: newest gradients, newest first, each of shape (parameters,).
    """

    structure: Structure
    scaling: Scaling
    forgetting: float
    estimator: RlsState
    own: tuple[float, ...]
    inputs: tuple[tuple[float, ...], ...]
    gradients: tuple[tuple[float, ...], ...]


class RecursiveOutputError:
    """Simulates an output, and corrects its parameters by each measured row.

    Args:
        structure: the model's terms; one output.
        scaling: scaling of the signals; without it they are taken as they are, which suits signals of the order of 1.
        forgetting: weight of a row relative to its successor, in (0, 1], once it has risen to it.

    Raises:
        ValueError: several outputs, or a setting out of its range.
    """

    def __init__(self, structure: Structure, scaling: Scaling | None = None, forgetting: float = 1.0) -> None:
        if structure.outputs != 1:
            raise InputError(f"an output-error model has one output, got {structure.outputs}: use one for each")
        self._structure = structure
        self._scaling = Scaling.none(structure.inputs, 1) if scaling is None else scaling
        self._forgetting = forgetting
        self._estimator = RecursiveLeastSquares(
            structure.parameters, min(START_FORGETTING, forgetting), COVARIANCE_LIMIT
        )
        self.restart()

    @classmethod
    def from_state(cls, state: RecursiveOutputErrorState) -> Self:
        """Resume, bit for bit from a state.

        Raises:
            ValueError: the state is damaged.
        """
        model = cls(state.structure, state.scaling, state.forgetting)
        model._estimator = RecursiveLeastSquares.from_state(state.estimator)
        model._filled = len(state.own)
        model._own[: model._filled] = state.own
        if model._filled:
            model._inputs[: model._filled] = state.inputs
            model._gradients[: model._filled] = state.gradients
        return model

    @property
    def state(self) -> RecursiveOutputErrorState:
        """A copy of the full state."""
        filled = self._filled
        return RecursiveOutputErrorState(
            self._structure,
            self._scaling,
            self._forgetting,
            self._estimator.state,
            tuple(map(float, self._own[:filled])),
            tuple(tuple(map(float, row)) for row in self._inputs[:filled]),
            tuple(tuple(map(float, row)) for row in self._gradients[:filled]),
        )

    def restart(self) -> None:
        """Clear the simulation, as after a gap in the rows; keep the parameters."""
        history = self._structure.history
        self._filled = 0
        self._own = np.zeros(history)
        self._inputs = np.zeros((history, self._structure.inputs))
        self._gradients = np.zeros((history, self._structure.parameters))

    def update(self, inputs: ArrayLike, output: float) -> RlsUpdate | None:
        """Simulate the output, then learn from its measurement.

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
            self._push(measured, new_inputs, np.zeros(self._structure.parameters))
            self._filled += 1
            return None
        regressor = self._regressor()
        old = self._estimator.parameters
        lags = self._structure.output_lags
        gradient = regressor + old[:lags] @ self._gradients[:lags]
        prediction = float(regressor @ old)
        result = self._estimator.update(gradient, measured - prediction + float(gradient @ old))
        new = self._project(old)
        if self._estimator.forgetting < self._forgetting:
            risen = FORGETTING_RISE * self._estimator.forgetting + (1.0 - FORGETTING_RISE)
            self._estimator.raise_forgetting(min(risen, self._forgetting))
        self._push(float(regressor @ new), new_inputs, gradient)
        centre, spread = self._scaling.output_centres[0], self._scaling.output_spreads[0]
        return RlsUpdate(
            prediction * spread + centre,
            (measured - prediction) * spread,
            result.residual_sd * spread,
            result.leverage,
        )

    @property
    def rows(self) -> int:
        """Number of rows learned from."""
        return self._estimator.rows

    @property
    def model(self) -> LinearModel:
        """The learned model, in the signals' own units."""
        return model_of(self._structure, self._scaling, self._estimator, simulates=True)

    def _regressor(self) -> NDArray[np.float64]:
        structure = self._structure
        first = structure.delay - 1
        parts = [self._own[: structure.output_lags], self._inputs[first : first + structure.input_lags].ravel()]
        return np.concatenate([*parts, [1.0]] if structure.offset else parts)

    def _project(self, old: NDArray[np.float64]) -> NDArray[np.float64]:
        """Halve the step that was made from `old` until the poles are inside the unit circle."""
        lags = self._structure.output_lags
        new = self._estimator.parameters
        if is_stable(new[:lags]):
            return new
        step = new - old
        for _ in range(_HALVINGS):
            step = 0.5 * step
            if is_stable(old[:lags] + step[:lags]):
                break
        else:
            step = np.zeros_like(old)
        self._estimator.set_parameters(old + step)
        return self._estimator.parameters

    def _push(self, own: float, inputs: NDArray[np.float64], gradient: NDArray[np.float64]) -> None:
        for memory, value in ((self._own, own), (self._inputs, inputs), (self._gradients, gradient)):
            memory[1:] = memory[:-1]
            memory[0] = value
