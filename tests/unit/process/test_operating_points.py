"""Steady states, their stability and the linear model, against the published reactor and independent computations."""

import numpy as np
import pytest
from scipy.optimize import brentq

from reactorwatch.arrays import Array
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.linearise import linearise
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.steady_state import SteadyState, steady_states

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


@pytest.mark.parametrize("coolant_flow", [85.0, 103.41, 111.0])
def test_linear_model_equals_differences(model: ProcessModel, coolant_flow: float) -> None:
    point = operating(model, coolant_flow).state
    linear = linearise(model, point, np.array([coolant_flow]))
    function, p = model.function(), model.values()

    def at(x: Array, u: Array) -> tuple[Array, Array]:
        rhs, y = function(x, u, p, 0, 0)
        return np.array(rhs).ravel(), np.array(y).ravel()

    u = np.array([coolant_flow])
    for column, step in enumerate((1e-6, 1e-3)):
        delta = step * np.eye(2)[column]
        (f_up, y_up), (f_down, y_down) = at(point + delta, u), at(point - delta, u)
        np.testing.assert_allclose(linear.A[:, column], (f_up - f_down) / (2 * step), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(linear.C[:, column], (y_up - y_down) / (2 * step), rtol=1e-6, atol=1e-6)
    (f_up, y_up), (f_down, y_down) = at(point, u + 1e-3), at(point, u - 1e-3)
    np.testing.assert_allclose(linear.B[:, 0], (f_up - f_down) / 2e-3, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(linear.D[:, 0], (y_up - y_down) / 2e-3, atol=1e-12)


def test_inputs_that_do_not_fit_are_refused(model: ProcessModel) -> None:
    with pytest.raises(ValueError, match=r"^inputs must be 1 finite numbers \(\('qc',\)\), got \[100\. *nan\]$"):
        steady_states(model, np.array([100.0, np.nan]))
