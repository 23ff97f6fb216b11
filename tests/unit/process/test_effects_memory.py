"""Effects that bring memory along, against their physics written out by hand and integrated by scipy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from reactorwatch.arrays import Array
from reactorwatch.process.library.cstr import OPERATING_STATE
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from tests.unit.process import by_hand
from tests.unit.process.by_hand import Rates, balances, duty, nominal
from tests.unit.process.effect_named import effect_of, extend_cstr

TIMES: Array = np.round(np.arange(200.0) * 0.1, 9)
FLOWS = np.repeat(np.random.default_rng(11).uniform(90, 111, 20), 10)
START = np.array(OPERATING_STATE)
ERROR = np.array([2e-6, 2e-3])
"""mol/l and K: a hundredth of what the sensors' noise is, or less."""


def run(rates: Rates, start: Array, flows: Array = FLOWS, time_min: Array = TIMES) -> Array:
    return by_hand.run(rates, start, time_min, flows)


def outputs(model: ProcessModel) -> Array:
    """Outputs of a simulation that starts in equilibrium."""
    return Simulator(model).run(TIMES, FLOWS, START).outputs


@pytest.mark.parametrize("m", [0.1, 0.7])
def test_the_duty_of_a_slow_jacket_follows_its_static_value(m: float) -> None:
    truth = run(
        lambda t, x, qc: [*balances(x, x[2]), (duty(x[1], qc) - x[2]) / m],
        np.array([*START, duty(START[1], FLOWS[0])]),
    )
    assert np.all(np.abs(outputs(extend_cstr("jacket_lag", m)) - truth[:, :2]) < ERROR)


def test_a_wall_takes_up_heat_at_two_a_minute() -> None:
    def rates(t: float, x: Array, qc: float) -> list[float]:
        dC, dT = nominal(t, x, qc)
        return [dC, dT + 0.3 * 2.0 * (x[2] - x[1]), 2.0 * (x[1] - x[2])]

    truth = run(rates, np.array([*START, START[1]]))
    assert np.all(np.abs(outputs(extend_cstr("wall_heat_capacity", 0.3)) - truth[:, :2]) < ERROR)


@pytest.mark.parametrize("m", [0.1, 0.7])
def test_the_flow_through_a_slow_valve_follows_the_command(m: float) -> None:
    truth = run(lambda t, x, qc: [*nominal(t, x, x[2]), (qc - x[2]) / m], np.array([*START, FLOWS[0]]))
    assert np.all(np.abs(outputs(extend_cstr("valve_lag", m)) - truth[:, :2]) < ERROR)


def valve_positions(flows: Array, m: float, onset: int = 0) -> Array:
    """Positions of a valve that moves only when the command is more than m away."""
    where = [flows[0]]
    for row, qc in enumerate(flows[1:].tolist(), start=1):
        where.append(qc if abs(qc - where[-1]) > m or row < onset else where[-1])
    return np.array(where)


@pytest.mark.parametrize("m", [3.0, 6.0])
def test_a_sticking_valve_stays_until_the_command_is_far_from_it_and_then_goes_there(m: float) -> None:
    flows = valve_positions(FLOWS, m)
    assert 0 < np.sum(flows != FLOWS) < FLOWS.size
    assert np.all(np.abs(outputs(extend_cstr("valve_stiction", m)) - run(nominal, START, flows)) < ERROR)


def test_a_valve_that_sticks_from_some_time_on_stands_where_it_was_then() -> None:
    model = extend_cstr("valve_stiction", 6.0, onset_min=4.95)
    truth = run(nominal, START, valve_positions(FLOWS, 6.0, onset=50))
    assert np.all(np.abs(outputs(model) - truth) < ERROR)


@pytest.mark.parametrize("m", [0.1, 0.7])
def test_a_thermowell_follows_the_temperature(m: float) -> None:
    truth = run(lambda t, x, qc: [*nominal(t, x, qc), (x[1] - x[2]) / m], np.array([*START, START[1]]))
    assert np.all(np.abs(outputs(extend_cstr("temperature_lag", m)) - truth[:, [0, 2]]) < ERROR)


@pytest.fixture(scope="module")
def dense() -> tuple[Array, Array]:
    """Times and concentrations of the plant, twenty to a row."""
    fine: Array = np.round(np.arange(4000.0) * 0.005, 9)
    return fine, run(nominal, START, np.repeat(FLOWS, 20), fine)[:, 0]


@pytest.mark.parametrize(
    ("m", "rms", "worst"),
    [(0.05, 1e-4, 6e-4), (0.3, 1e-4, 6e-4), (1.0, 1e-4, 6e-4), (2.0, 1e-3, 4e-3), (3.0, 4e-3, 0.012)],
)
def test_an_analyser_shows_what_was_there(m: float, rms: float, worst: float, dense: tuple[Array, Array]) -> None:
    """Against the exact delay, with the coolant stepping every minute over its whole range; noise is 0.002 mol/l."""
    off = outputs(extend_cstr("concentration_delay", m))[:, 0] - np.interp(TIMES - m, *dense)
    assert np.sqrt(np.mean(off**2)) < rms
    assert np.max(np.abs(off)) < worst


@pytest.mark.parametrize("cause", ["jacket_lag", "valve_lag", "temperature_lag"])
@pytest.mark.parametrize("m", [0.003, 0.02, 0.03, 0.05])
def test_lags_below_the_step_of_the_integrator_are_right_to_a_quarter_of_the_sensors_noise(
    cause: str, m: float
) -> None:
    if cause == "jacket_lag":
        first, rates = duty(START[1], FLOWS[0]), lambda t, x, qc: [*balances(x, x[2]), (duty(x[1], qc) - x[2]) / m]
    elif cause == "valve_lag":
        first, rates = FLOWS[0], lambda t, x, qc: [*nominal(t, x, x[2]), (qc - x[2]) / m]
    else:
        first, rates = START[1], lambda t, x, qc: [*nominal(t, x, qc), (x[1] - x[2]) / m]
    truth = run(rates, np.array([*START, first]))[:, [0, 2] if cause == "temperature_lag" else [0, 1]]
    found = outputs(extend_cstr(cause, m))
    assert np.all(np.abs(found - truth) < [0.0005, 0.075])
    assert np.all(np.std(found - truth, axis=0) < [0.0001, 0.018])


@pytest.mark.parametrize(("cause", "worst"), [("jacket_lag", 0.8), ("valve_lag", 2e-3), ("temperature_lag", 0.4)])
def test_a_lag_that_sets_in_right_after_the_flow_has_jumped_begins_with_what_is_there(cause: str, worst: float) -> None:
    """At 5.03 min, where the flow has jumped by 18 l/min at 5.0 min; in K, in the first minute, of a change of 15 K."""
    m, row = 0.5, 50
    before = run(nominal, START)[: row + 1]
    x = solve_ivp(nominal, (0, 0.03), before[row], args=(FLOWS[row],), rtol=1e-10, atol=1e-11).y[:, -1]
    first = {"jacket_lag": duty(x[1], FLOWS[row]), "valve_lag": FLOWS[row], "temperature_lag": x[1]}[cause]

    def rates(t: float, x: Array, qc: float) -> list[float]:
        cooling = x[2] if cause == "jacket_lag" else duty(x[1], x[2] if cause == "valve_lag" else qc)
        followed = {"jacket_lag": duty(x[1], qc), "valve_lag": qc}.get(cause, x[1])
        return [*balances(x, cooling), (followed - x[2]) / m]

    times = np.append(5.03, TIMES[row + 1 :])
    after = run(rates, np.array([*x, first]), FLOWS[row:], times)[1:, [0, 2] if cause == "temperature_lag" else [0, 1]]
    off = outputs(extend_cstr(cause, m, onset_min=5.03)) - np.vstack([before, after])
    assert np.max(np.abs(off[: row + 10, 1])) < worst


@pytest.mark.parametrize("first", ["jacket_lag", "coolant_flow"])
def test_a_jacket_lags_behind_the_coolant_that_flows_in_either_order(first: str) -> None:
    sizes = {"jacket_lag": 0.3, "coolant_flow": -0.05}
    second = "coolant_flow" if first == "jacket_lag" else "jacket_lag"
    found = outputs(extend_cstr(second, sizes[second], extend_cstr(first, sizes[first])))
    truth = run(
        lambda t, x, qc: [*balances(x, x[2]), (duty(x[1], 0.95 * qc) - x[2]) / 0.3],
        np.array([*START, duty(START[1], 0.95 * FLOWS[0])]),
    )
    assert np.all(np.abs(found - truth[:, :2]) < ERROR)


def test_a_thermowell_lags_behind_what_it_is_in_whatever_else_is_wrong_with_the_heat() -> None:
    """A loss of heat that is put into the model after it reaches it too."""
    found = outputs(extend_cstr("heat_loss", 0.02, extend_cstr("temperature_lag", 0.3)))
    other = outputs(extend_cstr("temperature_lag", 0.3, extend_cstr("heat_loss", 0.02)))
    np.testing.assert_allclose(found, other, rtol=0, atol=1e-5)


def test_a_sticking_valve_is_stamped_late_in_either_order() -> None:
    """What is measured m after a jump is what the valve has made of it."""
    one = outputs(extend_cstr("sample_timing", 0.04, extend_cstr("valve_stiction", 3.0)))
    other = outputs(extend_cstr("valve_stiction", 3.0, extend_cstr("sample_timing", 0.04)))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-6)


def test_two_lags_are_one_behind_the_other() -> None:
    model = extend_cstr("valve_lag", 0.3)
    model = effect_of("valve_lag").extend(model).with_values({"valve_lag_2.size": 0.2})
    truth = run(
        lambda t, x, qc: [*nominal(t, x, x[3]), (qc - x[2]) / 0.2, (x[2] - x[3]) / 0.3],
        np.array([*START, FLOWS[0], FLOWS[0]]),
    )
    assert np.all(np.abs(outputs(model) - truth[:, :2]) < ERROR)
