"""The tanks and their effects, as the catalogue's other models and effects are held."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from reactorwatch.process.library.cascaded_tanks import EFFECTS as TANK_EFFECTS
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import linearise, steady_states

TIMES = np.arange(60) / 15
FLOWS = np.repeat(np.random.default_rng(1).uniform(2.0, 5.0, 12), 5)
START = np.array([9.5, 6.0])  # the upper tank comes over its brim


def test_a_run_is_that_of_the_equations_by_hand() -> None:
    """dx1/dt = 3 u - 3 sqrt(x1), dx2/dt = 3 sqrt(x1) - 3 sqrt(x2), solved by scipy with tight tolerances."""
    expected = [START]
    for begin, end, u in zip(TIMES[:-1], TIMES[1:], FLOWS, strict=False):

        def rates(_: float, x: np.ndarray, u: float = u) -> list[float]:
            upper, lower = np.sqrt(x)
            return [3 * u - 3 * upper, 3 * upper - 3 * lower]

        expected.append(solve_ivp(rates, (begin, end), expected[-1], rtol=1e-10, atol=1e-12).y[:, -1])
    found = Simulator(tanks()).run(TIMES, FLOWS, START)
    np.testing.assert_allclose(found.states, expected, rtol=2e-5)
    np.testing.assert_array_equal(found.outputs[:, 0], found.states[:, 1])


def test_it_rests_where_what_runs_out_is_what_runs_in() -> None:
    """3 u = 3 sqrt(x1) = 3 sqrt(x2), with the eigenvalues -3 / (2 sqrt(x)) of both tanks."""
    (rest,) = steady_states(tanks(), np.array([2.0]))
    np.testing.assert_allclose(rest.state, [4.0, 4.0], rtol=1e-5)
    assert rest.stable
    np.testing.assert_allclose(rest.eigenvalues.real, [-0.75, -0.75], rtol=1e-3)


def test_near_a_point_the_linear_model_runs_as_the_tanks_do() -> None:
    (rest,) = steady_states(tanks(), np.array([2.0]))
    linear = linearise(tanks(), rest.state, np.array([2.0]))
    moved = Simulator(tanks()).run(TIMES, np.full(60, 2.001), rest.state).outputs[:, 0] - rest.state[1]
    A, B = linear.A, linear.B[:, 0]
    settled = np.linalg.solve(A, -B * 0.001)
    late = Simulator(tanks()).run(np.arange(600) / 15, np.full(600, 2.001), rest.state).outputs[-1, 0] - rest.state[1]
    assert late == pytest.approx(settled[1], rel=1e-3)
    assert np.all(np.diff(moved) >= 0.0)


def test_an_empty_tank_stays_empty_and_has_a_derivative() -> None:
    found = Simulator(tanks()).run(TIMES, np.zeros(60), np.array([0.05, 0.0])).states
    assert np.all(found >= -1e-9)
    assert found[-1, 0] < 1e-3
    assert np.all(np.isfinite(linearise(tanks(), np.zeros(2), np.zeros(1)).A))


def test_a_firm_brim_holds_the_level() -> None:
    overflow = next(effect for effect in TANK_EFFECTS if effect.name == "overflow").extend(tanks())
    high = np.full(60, 5.0)
    free = Simulator(tanks()).run(TIMES, high, START).states
    held = Simulator(overflow).run(TIMES, high, START, {"overflow.size": 60.0}).states
    assert free[-1, 0] > 14.0
    # what comes in and does not run out, 3 * 5 - 3 sqrt(10) V/min, runs over at a sixtieth of it above the brim
    assert held[-1, 0] == pytest.approx(10.0 + (15.0 - 3.0 * np.sqrt(10.0)) / 61.0, abs=0.01)
    assert held[-1, 1] < free[-1, 1]
