"""The linear model against differences, an independent solver, and the plant."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from reactorwatch.arrays import Array
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.linearise import compare_step, linearise, step_response
from reactorwatch.process.steady_state import steady_states

FLOWS = (85.0, 100.0, 110.0)


@pytest.mark.parametrize("flow", FLOWS)
def test_the_matrices_are_the_plant_s_differences(flow: float) -> None:
    model, u = cstr(), np.array([flow])
    function = model.function()
    for point in steady_states(model, u):
        linear = linearise(model, point.state, u)
        x, h = point.state, np.array([1e-6, 1e-3])

        def rhs(x: Array, u: Array) -> Array:
            return np.array(function(x, u, model.values(), 0.0, 0.0)[0]).ravel()

        A = np.column_stack([(rhs(x + e, u) - rhs(x - e, u)) / (2 * e.sum()) for e in np.diag(h)])
        B = (rhs(x, u + 1e-3) - rhs(x, u - 1e-3)) / 2e-3
        assert np.allclose(linear.A, A, rtol=1e-5, atol=1e-7)
        assert np.allclose(linear.B[:, 0], B, rtol=1e-5, atol=1e-9)
        assert np.array_equal(linear.C, np.eye(2))
        assert np.array_equal(linear.D, np.zeros((2, 1)))


@pytest.mark.parametrize("flow", FLOWS)
def test_the_error_against_the_plant_falls_with_the_square_of_the_step(flow: float) -> None:
    model, u = cstr(), np.array([flow])
    point = steady_states(model, u)[-1]
    errors = []
    for step in (0.4, 0.2, 0.1):
        comparison = compare_step(model, point.state, u, np.array([step]))
        errors.append(np.abs(comparison.linear - comparison.plant).max(axis=0))
    order = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(np.abs(order - 2.0) < 0.1)


def test_the_linear_step_response_is_the_solution_of_its_equation() -> None:
    model, u = cstr(), np.array([100.0])
    linear = linearise(model, steady_states(model, u)[-1].state, u)
    time_min, step = np.linspace(0, 5, 51), np.array([3.0])
    solved = solve_ivp(
        lambda _t, x: linear.A @ x + linear.B @ step, (0, 5), [0, 0], "DOP853", time_min, rtol=1e-11, atol=1e-13
    )
    assert np.allclose(step_response(linear, step, time_min), solved.y.T @ linear.C.T, rtol=1e-7, atol=1e-9)
