"""Steady states, their stability and the linear model, against the published reactor and independent computations."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from reactorwatch.arrays import Array
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.steady_state import SteadyState, compare_step, linearise, steady_states, step_response

# Computed from the published equations of the benchmark (De Moor, DaISy; Lightbody & Irwin 1997) by the project's
# plant description: coolant flow, C, T on the operating branch, one eigenvalue of the pair (or both, if real).
OPERATING_BRANCH = [
    (85.0, 0.0521787, 452.4796, (-8.769, -2.987)),
    (90.0, 0.0620407, 448.7522, -4.351 + 1.539j),
    (95.0, 0.0738523, 445.0187, -3.068 + 2.762j),
    (100.0, 0.0882316, 441.2184, -1.983 + 3.059j),
    (103.41, 0.1000129, 438.5417, -1.336 + 3.030j),
    (105.0, 0.1062143, 437.2555, -1.057 + 2.970j),
    (108.0, 0.1194956, 434.7313, -0.564 + 2.785j),
    (110.0, 0.1298253, 432.9487, -0.258 + 2.610j),
    (111.0, 0.1355650, 432.0157, -0.111 + 2.505j),
]


@pytest.fixture(scope="module")
def model() -> ProcessModel:
    return cstr()


def operating(model: ProcessModel, coolant_flow: float) -> SteadyState:
    return steady_states(model, np.array([coolant_flow]))[-1]


@pytest.mark.parametrize(("coolant_flow", "C", "T", "eigenvalues"), OPERATING_BRANCH)
def test_operating_branch_is_the_published_one(
    model: ProcessModel, coolant_flow: float, C: float, T: float, eigenvalues: complex | tuple[float, float]
) -> None:
    found = operating(model, coolant_flow)
    pair = np.array(eigenvalues if isinstance(eigenvalues, tuple) else (eigenvalues.conjugate(), eigenvalues))
    assert found.state == pytest.approx([C, T], abs=5e-5, rel=5e-7)
    assert found.outputs == pytest.approx(found.state)
    np.testing.assert_allclose(found.eigenvalues, pair, rtol=0, atol=5.1e-4)  # printed to three decimals
    assert found.stable


def test_at_the_nominal_flow_there_are_the_published_three() -> None:
    extinguished, middle, hot = steady_states(cstr(), np.array([103.41]))
    assert extinguished.state == pytest.approx([0.96389, 353.553], abs=5e-4)
    assert middle.state == pytest.approx([0.47622, 401.530], abs=5e-4)
    assert hot.state == pytest.approx([0.1000129, 438.5417], abs=5e-5)
    assert [extinguished.stable, middle.stable, hot.stable] == [True, False, True]
    assert (middle.kind, hot.kind) == ("saddle", "stable focus")


@pytest.mark.parametrize("coolant_flow", [0.0, 5.0, 20.0, 60.0, 85.0, 103.41, 111.0, 115.0, 117.5, 130.0, 200.0, 500.0])
def test_every_steady_state_is_found_and_no_other(model: ProcessModel, coolant_flow: float) -> None:
    """Against an exhaustive scan over T: the mass balance gives C for each, the energy balance is left to be zero."""

    def concentration(T: float) -> float:
        return float(1.0 / (1.0 + 7.2e10 * np.exp(-1e4 / T)))

    def imbalance(T: float) -> float:
        duty = 0.01 * coolant_flow * (1 - np.exp(-700 / coolant_flow)) if coolant_flow else 0.0
        return float(350 - T + 1.44e13 * np.exp(-1e4 / T) * concentration(T) + duty * (350 - T))

    scan = np.arange(340.0, 600.0, 0.02)
    signs = np.sign([imbalance(T) for T in scan])
    roots = [brentq(imbalance, scan[i], scan[i + 1], xtol=1e-11) for i in np.flatnonzero(signs[1:] != signs[:-1])]
    expected = [[concentration(T), T] for T in roots]
    found = [item.state for item in steady_states(model, np.array([coolant_flow]))]
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-6)


def test_inputs_that_do_not_fit_are_refused(model: ProcessModel) -> None:
    with pytest.raises(ValueError, match=r"^inputs must be 1 finite numbers \(\('qc',\)\), got \[100\. *nan\]$"):
        steady_states(model, np.array([100.0, np.nan]))


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
