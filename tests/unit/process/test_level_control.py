"""The reactor with a level of its own: its limit is the plant of constant volume."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from reactorwatch.arrays import Array
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.cstr_operation import LevelControl
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import steady_states

TIME_MIN = np.arange(0.0, 20.0, 0.1)
QC = np.repeat([100.0, 95.0, 105.0, 98.0], 50)
START = np.array([0.0882, 441.2])


def test_at_its_set_point_it_is_the_plant_of_constant_volume() -> None:
    constant = Simulator(cstr()).run(TIME_MIN, QC, START).outputs
    held = Simulator(LevelControl().extend(cstr())).run(TIME_MIN, QC, np.array([*START, 100.0])).outputs
    assert np.allclose(held, constant, rtol=1e-9, atol=1e-9)


def test_the_faster_the_controller_the_closer_it_comes_to_constant_volume() -> None:
    """The distance falls in proportion to 1 / gain, for an inflow other than the controller reckons with."""
    change = {"q": 97.0}
    constant = Simulator(cstr()).run(TIME_MIN, QC, START, change).outputs[-1]
    distance = []
    for gain in (5.0, 10.0, 20.0, 40.0):
        model = LevelControl(gain).extend(cstr())
        rest = 100.0 - 3.0 / gain
        held = Simulator(model).run(TIME_MIN, QC, np.array([*START, rest]), change).outputs[-1]
        distance.append(np.abs(held - constant))
    ratios = np.array(distance[:-1]) / np.array(distance[1:])
    assert np.all((ratios > 1.8) & (ratios < 2.2))


def test_the_level_rests_where_a_proportional_controller_leaves_it() -> None:
    model = LevelControl(5.0).extend(cstr()).with_values({"q": 90.0})
    for point in steady_states(model, np.array([95.0])):
        assert point.state[2] == pytest.approx(100.0 - 10.0 / 5.0)


def test_it_has_the_steady_states_of_the_plant_of_constant_volume() -> None:
    plain = steady_states(cstr(), np.array([103.41]))
    held = steady_states(LevelControl().extend(cstr()), np.array([103.41]))
    assert np.allclose([p.state for p in plain], [h.state[:2] for h in held])
    assert [p.stable for p in plain] == [h.stable for h in held]


def test_an_independent_solver_agrees_on_the_balances_of_amounts() -> None:
    """Moles and heat content are balanced here, V C and V T, not C and T; K2 in terms of the jacket's duty."""
    gain, q, qc = 2.0, 90.0, 98.0

    def balances(_t: float, n: Array) -> list[float]:
        moles, heat, V = n
        C, T = moles / V, heat / V
        out = max(0.0, 100.0 + gain * (V - 100.0))
        rate = V * C * np.exp(-1e4 / T)
        duty = 0.01 * 100.0 * qc * (1 - np.exp(-700.0 / qc)) * (350.0 - T)
        return [q * 1.0 - out * C - 7.2e10 * rate, q * 350.0 - out * T + 1.44e13 * rate + duty, q - out]

    start = np.array([*START, 110.0])
    model = LevelControl(gain).extend(cstr())
    ours = Simulator(model).run(TIME_MIN, np.full(TIME_MIN.size, qc), start, {"q": q}).states
    amounts = [start[0] * start[2], start[1] * start[2], start[2]]
    theirs = solve_ivp(balances, (0, TIME_MIN[-1]), amounts, "LSODA", TIME_MIN, rtol=1e-10, atol=1e-10).y.T
    assert np.allclose(ours[:, 2], theirs[:, 2], rtol=1e-6)
    assert np.allclose(ours[:, :2], theirs[:, :2] / theirs[:, 2:], rtol=1e-6)


def test_a_model_without_a_volume_is_refused() -> None:
    with pytest.raises(ValueError, match="has no parameter 'V'"):
        LevelControl().extend(LevelControl().extend(cstr()))
