"""Free runs, the step of integration and its grid: against independent solvers and a measured record; errors."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import ArrayFunction
from reactorwatch.process.library.cstr import OPERATING_STATE, cstr
from reactorwatch.process.profiles import STEP
from reactorwatch.process.simulate import SimulationError, Simulator, Stepper, step_grid, symbolic_step
from tests.tables import read_csv
from tests.unit.process.by_hand import nominal
from tests.unit.process.effect_named import effect_of

START = np.array(OPERATING_STATE)


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(cstr())


def independent(time_min: Array, flows: Array, method: Literal["LSODA", "DOP853"]) -> Array:
    """The run by scipy, started anew at every change of the input."""
    states = [START]
    edges = [0, *(np.flatnonzero(np.diff(flows)) + 1), time_min.size - 1]
    for first, last in pairwise(edges):
        if last > first:
            part = slice(first, last + 1)
            run = solve_ivp(
                nominal,
                (time_min[first], time_min[last]),
                states[-1],
                method,
                t_eval=time_min[part],
                args=(flows[first],),
                rtol=1e-10,
                atol=1e-12,
            )
            assert run.success
            states.extend(run.y.T[1:])
    return np.array(states)


@pytest.mark.parametrize("method", ["LSODA", "DOP853"])
def test_random_steps_agree_with_scipy(simulator: Simulator, method: Literal["LSODA", "DOP853"]) -> None:
    time_min = np.arange(1000, dtype=np.float64) * 0.1
    flows = np.repeat(np.random.default_rng(1).uniform(90, 111, 100), 10)
    found = simulator.run(time_min, flows, START)
    assert np.all(np.abs(found.states - independent(time_min, flows, method)) <= np.array([1e-7, 5e-5]))


def test_extinction_and_ignition_agree_with_scipy(simulator: Simulator) -> None:
    """Out at 135 l/min, burning again at 2 l/min, back on the operating branch at 100 l/min."""
    time_min = np.arange(600, dtype=np.float64) * 0.1
    flows = np.full(600, 100.0)
    flows[100:200], flows[200:400] = 135.0, 2.0
    found = simulator.run(time_min, flows, START).states
    assert found[:, 1].min() < 355
    assert found[:, 1].max() > 545
    np.testing.assert_allclose(found[-1], [0.0882316, 441.2184], rtol=0, atol=1e-4)
    assert np.all(np.abs(found - independent(time_min, flows, "DOP853")) <= np.array([1e-6, 1e-3]))


def test_irregular_times_and_gaps_are_no_matter(simulator: Simulator) -> None:
    """The input of a row is held until the next, however far away that is."""
    rng = np.random.default_rng(2)
    time_min = np.cumsum(rng.choice([0.013, 0.1, 0.72, 3.0], 120))
    flows = rng.uniform(90, 111, 120)
    found = simulator.run(time_min, flows, START)
    assert np.all(np.abs(found.states - independent(time_min, flows, "DOP853")) <= np.array([1e-7, 5e-5]))


def test_a_run_longer_than_a_chain_is_the_same_as_its_parts(simulator: Simulator) -> None:
    time_min = np.arange(801, dtype=np.float64) * 0.1
    flows = np.repeat(np.random.default_rng(3).uniform(90, 111, 267), 3)
    whole = simulator.run(time_min, flows, START).states
    head = simulator.run(time_min[:138], flows[:138], START).states
    tail = simulator.run(time_min[137:], flows[137:], head[-1]).states
    np.testing.assert_allclose(np.vstack([head, tail[1:]]), whole, rtol=0, atol=1e-10)


def test_measured_record_is_reproduced(simulator: Simulator, daisy_csv: Path) -> None:
    """RMSE of the nominal equations on the DaISy record "CSTR": 2.6e-4 mol/l and 0.049 K."""
    record = read_csv(daisy_csv)
    C, T = record.columns["C"], record.columns["T"]
    run = simulator.run(record.time_min, record.columns["qc"], np.array([C[0], T[0]]))
    error = run.outputs - np.column_stack([C, T])
    rmse = np.sqrt(np.mean(error**2, axis=0))
    assert record.rows == 7500
    assert rmse[0] <= 2.7e-4
    assert rmse[1] <= 0.05


def test_a_fault_with_an_onset_is_two_runs_that_meet_there(simulator: Simulator) -> None:
    """A step of the coolant flow by -10 % at 3.37 min is the nominal plant until then, and with 90 % of qc after."""
    time_min = np.sort(np.append(np.arange(80, dtype=np.float64) * 0.1, 3.37))
    onset = int(np.searchsorted(time_min, 3.37))
    flows = np.full(time_min.size, 100.0)
    faulty = Simulator(effect_of("coolant_flow").extend(cstr(), STEP))
    found = faulty.run(
        np.delete(time_min, onset),
        np.delete(flows, onset),
        START,
        {"coolant_flow.size": -0.1, "coolant_flow.onset": 3.37},
    )
    flows[onset:] = 90.0
    expected = np.delete(simulator.run(time_min, flows, START).states, onset, axis=0)
    np.testing.assert_allclose(found.states, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("time_min", "inputs", "start", "text"),
    [
        ([0.0], [100.0], [0.1, 438.0], "a run must have at least 2 rows, got 1"),
        ([0.0, 0.1, 0.1], [100.0] * 3, [0.1, 438.0], "times must increase, got 0.1 after 0.1 min (row 2)"),
        ([0.0, 0.1], [100.0], [0.1, 438.0], "inputs must have shape (2, 1), got (1, 1)"),
        ([0.0, 0.1], [100.0, 501.0], [0.1, 438.0], "qc must be in [0, 500] l/min, got 501 at 0.1 min"),
        ([0.0, 0.1], [100.0, np.nan], [0.1, 438.0], "qc must be in [0, 500] l/min, got nan at 0.1 min"),
        ([0.0, 0.1], [100.0] * 2, [0.1], "start must be 2 finite numbers (('C', 'T')), got [0.1]"),
        ([0.0, 0.1], [100.0] * 2, [0.1, np.inf], "start must be 2 finite numbers (('C', 'T')), got [0.1 inf]"),
    ],
)
def test_what_cannot_be_run_is_refused(
    simulator: Simulator, time_min: list[float], inputs: list[float], start: list[float], text: str
) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011 (the text is compared as a whole)
        simulator.run(np.array(time_min), np.array(inputs), np.array(start))
    assert str(caught.value) == text


def test_parameters_out_of_bounds_are_refused(simulator: Simulator) -> None:
    times, flows = np.array([0.0, 0.1]), np.array([100.0, 100.0])
    with pytest.raises(ValueError, match=r"^V must be in \[1, 1000\], got 0$"):
        simulator.run(times, flows, START, {"V": 0.0})
    with pytest.raises(ValueError, match=r"^cstr has no parameter 'W' \(it has q, V, Cf, "):
        simulator.run(times, flows, START, {"W": 1.0})


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
