"""Linear model at a point: first-order Taylor expansion with symbolic derivatives."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel


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
