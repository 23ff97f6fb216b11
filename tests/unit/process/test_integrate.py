"""The step of integration and the grid of steps."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from reactorwatch.codegen.array_function import ArrayFunction
from reactorwatch.process.library.cstr import OPERATING_STATE, cstr
from reactorwatch.process.profiles import STEP
from reactorwatch.process.simulate import SimulationError, Stepper, step_grid, symbolic_step
from tests.unit.process.by_hand import nominal
from tests.unit.process.effect_named import effect_of


def test_observed_order_is_five() -> None:
    """Halving the step divides the error by 2^5, over a swing after a jump of the coolant flow."""
    span, start = 0.8, np.array([0.08, 441.0])
    exact = solve_ivp(nominal, (0, span), start, "DOP853", args=(95.0,), rtol=1e-13, atol=1e-13).y[:, -1]
    model = cstr()
    step = ArrayFunction(symbolic_step(model))
    x, u, p, _, _, h = step.arguments
    errors = []
    for count in (8, 16, 32):
        x[0], u[0], p[0], h[0] = start, 95.0, model.values(), span / count
        for _ in range(count):
            step()
            x[0] = step.results[0][0]
        errors.append(np.abs(x[0] - exact) / [0.1, 10.0])
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(orders >= 4.5), orders


def test_error_estimate_is_no_smaller_than_the_error() -> None:
    start, h = np.array([0.08, 441.0]), 0.1
    exact = solve_ivp(nominal, (0, h), start, "DOP853", args=(95.0,), rtol=1e-13, atol=1e-13).y[:, -1]
    model = cstr()
    after, estimate = symbolic_step(model)(start, 95.0, model.values(), 0, 0, h)
    error = np.max(np.abs(np.array(after).ravel() - exact) / [0.1, 10.0])
    assert error <= float(estimate) <= 1000 * error


def test_stepper_finds_its_way_through_an_ignition() -> None:
    """Almost without coolant the reactor ignites within minutes, and its time constants shrink to seconds."""
    model = cstr()
    start = np.array([0.9, 372.0])
    exact = solve_ivp(nominal, (0, 3), start, "DOP853", args=(5.0,), rtol=1e-12, atol=1e-12).y[:, -1]
    assert exact[1] > 530
    found = Stepper(model).advance(start, np.array([5.0]), model.values(), 0.0, 3.0)
    assert np.all(np.abs(found - exact) <= [1e-6, 1e-3])


def test_stepper_does_not_step_across_an_onset() -> None:
    """One advance over an onset is the same as two that meet there."""
    model = (
        effect_of("coolant_flow")
        .extend(cstr(), STEP)
        .with_values({"coolant_flow.size": -0.3, "coolant_flow.onset": 0.0371})
    )
    stepper, u, p = Stepper(model), np.array([100.0]), model.values()
    whole = stepper.advance(np.array(OPERATING_STATE), u, p, 0.0, 0.1)
    parts = stepper.advance(stepper.advance(np.array(OPERATING_STATE), u, p, 0.0, 0.0371), u, p, 0.0371, 0.1)
    np.testing.assert_allclose(whole, parts, rtol=1e-12)


def test_equations_that_diverge_are_reported_with_the_time() -> None:
    """dT/dt = T^2 from 300 K has no value after 1/300 min."""
    model = cstr()
    runaway = replace(model, rhs=(ca.SX(0), model.states[1].symbol ** 2))
    with pytest.raises(
        SimulationError, match=r"^cstr cannot be integrated beyond 0\.00333\d* min, where C = 0\.1 mol/l"
    ):
        Stepper(runaway).advance(np.array([0.1, 300.0]), np.array([100.0]), model.values(), 0.0, 1.0)


def test_equations_too_stiff_for_it_are_reported_and_do_not_hang() -> None:
    """A time constant of 1e-8 min would take millions of steps to the next sample."""
    model = cstr()
    stiff = replace(model, rhs=(ca.SX(0), 1e8 * (400 - model.states[1].symbol)))
    with pytest.raises(SimulationError, match=r"^cstr cannot be integrated beyond .* T = 400 K$"):
        Stepper(stiff).advance(np.array([0.1, 400.001]), np.array([100.0]), model.values(), 0.0, 0.1)


def test_grid_ends_a_step_at_every_sample_and_breakpoint() -> None:
    time_min = np.array([0.0, 0.1, 0.37, 0.4])
    grid = step_grid(time_min, np.array([0.2123, -1.0, 9.0]))
    ends = grid.start_min + grid.length_min
    np.testing.assert_allclose(ends[grid.end_of_row], time_min[1:], rtol=0, atol=1e-15)
    assert np.min(np.abs(ends - 0.2123)) < 1e-15
    assert np.all(grid.length_min <= 0.05 + 1e-12)
    np.testing.assert_allclose(np.diff(grid.start_min), grid.length_min[:-1], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(grid.row, np.searchsorted(time_min, grid.start_min + 1e-9) - 1)


def test_two_faults_may_set_in_at_once() -> None:
    model = effect_of("heat_transfer").extend(effect_of("coolant_flow").extend(cstr(), STEP), STEP)
    p = model.values({"coolant_flow.onset": 0.03, "heat_transfer.onset": 0.03, "coolant_flow.size": -0.1})
    only_one = effect_of("coolant_flow").extend(cstr(), STEP)
    expected = Stepper(only_one).advance(
        np.array(OPERATING_STATE),
        np.array([100.0]),
        only_one.values({"coolant_flow.onset": 0.03, "coolant_flow.size": -0.1}),
        0.0,
        0.1,
    )
    found = Stepper(model).advance(np.array(OPERATING_STATE), np.array([100.0]), p, 0.0, 0.1)
    np.testing.assert_array_equal(found, expected)
