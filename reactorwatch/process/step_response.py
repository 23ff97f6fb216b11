"""Step responses of the plant and of its linear model.

The error of a first-order Taylor expansion falls with the square of the step, so halving the step halves the error
relative to the response; its size at a given step shows whether the linear model is useful there.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from reactorwatch.arrays import Array
from reactorwatch.process.linearise import Linearization, linearise
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import SteadyState


@dataclass(frozen=True, eq=False)
class StepComparison:
    """Step responses of the plant and of the linear model, from a steady state.

    Attributes:
        time_min: time since the step, shape (rows,).
        plant: deviations of the plant's outputs from the steady state, shape (rows, n_y).
        linear: deviations of the linear model's outputs, shape (rows, n_y).
    """

    time_min: Array
    plant: Array
    linear: Array

    @property
    def error(self) -> Array:
        """Root mean square error relative to the plant's response, shape (n_y,)."""
        difference = np.sqrt(np.mean((self.linear - self.plant) ** 2, axis=0))
        size: Array = difference / np.sqrt(np.mean(self.plant**2, axis=0))
        return size


def step_response(linear: Linearization, step: Array, time_min: Array) -> Array:
    """Exact step response of a linear model's outputs, shape (rows, n_y).

    The exponential of the matrix [[A, B u], [0, 0]] steps the state over an interval with u constant: Van Loan (1978),
    Computing integrals involving the matrix exponential, IEEE Trans. Automatic Control 23(3).

    Args:
        linear: the linear model.
        step: shape (n_u,).
        time_min: shape (rows,), from 0 on.
    """
    n_x = linear.A.shape[0]
    block = np.zeros((n_x + 1, n_x + 1))
    block[:n_x, :n_x], block[:n_x, n_x] = linear.A, linear.B @ step
    states = np.array([expm(block * t)[:n_x, n_x] for t in time_min])
    response: Array = states @ linear.C.T + linear.D @ step
    return response


def compare_step(
    model: ProcessModel, point: SteadyState, inputs: Array, step: Array, span_min: float = 10.0, period_min: float = 0.1
) -> StepComparison:
    """Compare the step responses of plant and linear model at a steady state.

    Args:
        model: the process.
        point: a steady state at `inputs`.
        inputs: inputs before the step, shape (n_u,).
        step: change of the inputs, shape (n_u,).
        span_min: length of the response.
        period_min: sampling period.

    Raises:
        ValueError: the stepped input is outside its bounds.
    """
    time_min: Array = np.arange(round(span_min / period_min) + 1, dtype=np.float64) * period_min
    stepped = np.tile(inputs + step, (time_min.size, 1))
    plant = Simulator(model).run(time_min, stepped, point.state).outputs - point.outputs
    return StepComparison(time_min, plant, step_response(linearise(model, point.state, inputs), step, time_min))
