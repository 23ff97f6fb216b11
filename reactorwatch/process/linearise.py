"""Linear model at a point, a first-order Taylor expansion with symbolic derivatives, and step responses.

The error of a first-order Taylor expansion falls with the square of the step, so halving the step halves the error
relative to the response; its size at a given step shows whether the linear model is useful there.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from reactorwatch.arrays import Array
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel
from reactorwatch.process.simulate import Simulator


@dataclass(frozen=True, eq=False)
class Linearization:
    """d(dx)/dt = A dx + B du, dy = C dx + D du, for deviations from the point.

    Attributes:
        A: shape (n_x, n_x), 1/min where the states share a unit.
        B: shape (n_x, n_u).
        C: shape (n_y, n_x).
        D: shape (n_y, n_u).
    """

    A: Array
    B: Array
    C: Array
    D: Array

    @property
    def eigenvalues(self) -> NDArray[np.complex128]:
        """Eigenvalues of A, in 1/min, shape (n_x,), by increasing real part."""
        values = np.linalg.eigvals(self.A).astype(np.complex128)
        return values[np.lexsort((values.imag, values.real))]


def linearise(
    model: ProcessModel,
    state: Array,
    inputs: Array,
    time_min: float = 0.0,
    changes: Mapping[str, float] | None = None,
) -> Linearization:
    """Linearise a model at a point, which need not be a steady state.

    Args:
        model: the process.
        state: shape (n_x,).
        inputs: shape (n_u,).
        time_min: time, for models with time-dependent effects.
        changes: parameters that differ from the model's values.
    """
    matrices = _derivatives(model)(state, inputs, model.values(changes), time_min, time_min)
    return Linearization(*map(np.array, matrices))


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _derivatives(model: ProcessModel) -> ca.Function:
    """(x, u, p, t, t_middle) -> A, B, C, D."""
    x, u, p = model.arguments()
    clock = model.clock
    rhs = ca.vertcat(*model.rhs)
    y = ca.vertcat(*(output.expression for output in model.outputs))
    return ca.Function(
        "linear",
        [x, u, p, clock.now, clock.middle],
        [ca.jacobian(rhs, x), ca.jacobian(rhs, u), ca.jacobian(y, x), ca.jacobian(y, u)],
    )


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
    model: ProcessModel, state: Array, inputs: Array, step: Array, span_min: float = 10.0, period_min: float = 0.1
) -> StepComparison:
    """Compare the step responses of plant and linear model at a steady state.

    Args:
        model: the process.
        state: a steady state at `inputs`, shape (n_x,).
        inputs: inputs before the step, shape (n_u,).
        step: change of the inputs, shape (n_u,).
        span_min: length of the response.
        period_min: sampling period.

    Raises:
        ValueError: the stepped input is outside its bounds.
    """
    time_min: Array = np.arange(round(span_min / period_min) + 1, dtype=np.float64) * period_min
    outputs = np.array(model.function()(state, inputs, model.values(), 0.0, 0.0)[1]).ravel()
    stepped = np.tile(inputs + step, (time_min.size, 1))
    plant = Simulator(model).run(time_min, stepped, state).outputs - outputs
    return StepComparison(time_min, plant, step_response(linearise(model, state, inputs), step, time_min))
