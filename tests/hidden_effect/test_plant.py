"""The plant that effects are hidden in is right: held against SciPy, closed forms and published operating points."""

from collections.abc import Callable
from math import exp

import numpy as np
import pytest
from scipy.integrate import OdeSolution, solve_ivp

from tests.hidden_effect import reactor
from tests.hidden_effect.courses import Array, HiddenCourse
from tests.hidden_effect.plant import Controller, Plan, Played, play

TIME: Array = 0.1 * np.arange(40, dtype=np.float64)
COMMAND: Array = np.repeat(np.random.default_rng(3).uniform(92.0, 109.0, 8), 5)
START = (0.1, 438.54)

Rates = Callable[[float, Array, float], list[float]]


def solved(rates: Rates, flow: float, begin: float, end: float, start: Array) -> OdeSolution:
    """Solution by SciPy's solver of order 8 with the flow held, as good as exact."""

    def held(t: float, x: Array) -> list[float]:
        return rates(t, x, flow)

    found = solve_ivp(held, (begin, end), start, method="DOP853", dense_output=True, rtol=1e-11, atol=1e-12)
    assert found.sol is not None
    return found.sol


def scipy_run(rates: Rates, start: list[float], command: Array = COMMAND) -> Array:
    """States at the rows, the command held from row to row; shape (rows, states)."""
    found = [np.array(start)]
    for t, after, flow in zip(TIME[:-1], TIME[1:], command, strict=False):
        found.append(solved(rates, flow, t, after, found[-1])(after))
    return np.array(found)


def balances(C: float, T: float, flow: float, **changed: float) -> list[float]:
    """The plant's equations as they are published, some numbers changed."""
    p = {"q": 100.0, "V": 100.0, "Cf": 1.0, "Tf": 350.0, "Tcf": 350.0, "E": 1e4, "k0": 7.2e10, "K1": 1.44e13}
    p |= {"K2": 0.01, "K3": 700.0} | changed
    reaction = C * exp(-p["E"] / T)
    cooling = p["K2"] * flow * (1.0 - exp(-p["K3"] / flow))
    return [
        p["q"] / p["V"] * (p["Cf"] - C) - p["k0"] * reaction,
        p["q"] / p["V"] * (p["Tf"] - T) + p["K1"] * reaction + cooling * (p["Tcf"] - T),
    ]


def hidden(name: str, size: float, **more: float) -> Played:
    """A run with an effect from the first row on."""
    course = HiddenCourse("constant", size)
    return play(Plan(TIME, COMMAND, {name: course}, start=START, **more))  # type: ignore[arg-type]


@pytest.mark.parametrize(("flow", "C", "T"), [(85.0, 0.0521787, 452.4796), (103.41, 0.1000129, 438.5417)])
def test_at_rest_it_is_where_the_published_operating_points_are(flow: float, C: float, T: float) -> None:
    time_min = 0.1 * np.arange(300, dtype=np.float64)
    state = play(Plan(time_min, np.full(300, flow))).state[-1]
    assert state == pytest.approx([C, T], rel=2e-6)


def test_its_error_falls_with_the_fourth_power_of_the_step() -> None:
    plan = Plan(TIME, COMMAND, start=START)
    exact = scipy_run(lambda t, x, u: balances(x[0], x[1], u), list(START))
    coarse, fine = (np.abs(play(plan, step).state - exact).max() for step in (0.02, 0.01))
    assert 12.0 < coarse / fine < 20.0


CHANGED: dict[str, tuple[float, Callable[[float, Array, float], list[float]]]] = {
    "feed_temperature": (2.0, lambda t, x, u: balances(x[0], x[1], u, Tf=352.0)),
    "feed_concentration": (0.01, lambda t, x, u: balances(x[0], x[1], u, Cf=1.01)),
    "feed_flow": (0.02, lambda t, x, u: balances(x[0], x[1], u, q=102.0)),
    "reaction_rate": (0.05, lambda t, x, u: balances(x[0], x[1], u, k0=7.56e10, K1=1.512e13)),
    "activation_energy": (-0.002, lambda t, x, u: balances(x[0], x[1], u, E=9980.0)),
    "reaction_heat": (0.01, lambda t, x, u: balances(x[0], x[1], u, K1=1.4544e13)),
    "heat_transfer": (-0.5, lambda t, x, u: balances(x[0], x[1], u, K3=350.0)),
    "coolant_temperature": (-1.5, lambda t, x, u: balances(x[0], x[1], u, Tcf=348.5)),
    "coolant_flow": (-0.02, lambda t, x, u: balances(x[0], x[1], 0.98 * u)),
    "volume": (0.1, lambda t, x, u: balances(x[0], x[1], u, V=110.0, K2=0.01 / 1.1)),
    "bypass": (0.02, lambda t, x, u: balances(x[0], x[1], u, q=98.0)),
    "reaction_order": (
        0.1,
        lambda t, x, u: balances(x[0], x[1], u, k0=7.2e10 * (x[0] / 0.1) ** 0.1, K1=1.44e13 * (x[0] / 0.1) ** 0.1),
    ),
    "heat_loss": (0.01, lambda t, x, u: list(np.add(balances(x[0], x[1], u), [0.0, -0.01 * (x[1] - 298.0)]))),
    "side_reaction": (
        0.2,
        lambda t, x, u: list(
            np.add(balances(x[0], x[1], u), 0.2 * x[0] * exp(-15e3 * (1 / x[1] - 1 / 438.54)) * np.array([-1.0, 100.0]))
        ),
    ),
    "boiling": (0.5, lambda t, x, u: list(np.add(balances(x[0], x[1], u), [0.0, -0.5 * max(x[1] - 440.0, 0.0)]))),
    "random_heat": (1.5, lambda t, x, u: list(np.add(balances(x[0], x[1], u), [0.0, 1.5]))),
    "dilution_pulses": (0.03, lambda t, x, u: list(np.add(balances(x[0], x[1], u), [-0.03 * x[0], 0.0]))),
    "feed_pulses": (0.03, lambda t, x, u: balances(x[0], x[1], u, Cf=1.03)),
    "curved_valve": (0.02, lambda t, x, u: balances(x[0], x[1], u * (1 + 0.02 * ((u - 100) / 10) ** 2))),
    "substrate_inhibition": (
        0.02,
        lambda t, x, u: balances(x[0], x[1], u, k0=7.2e10 / (1 + 2.0 * x[0] ** 2), K1=1.44e13 / (1 + 2.0 * x[0] ** 2)),
    ),
    "inhibited_when_hot": (
        0.4,
        lambda t, x, u: balances(
            x[0],
            x[1],
            u,
            k0=7.2e10 / (1 + 0.04 * max(x[1] - 440.0, 0.0)),
            K1=1.44e13 / (1 + 0.04 * max(x[1] - 440.0, 0.0)),
        ),
    ),
}


@pytest.mark.parametrize("name", CHANGED)
def test_an_effect_on_the_balances_is_what_scipy_makes_of_the_changed_equations(name: str) -> None:
    size, rates = CHANGED[name]
    nominal = play(Plan(TIME, COMMAND, start=START)).state
    exact = scipy_run(rates, list(START))
    # Where the equations have a kink at some temperature, a step across it is of lower order.
    bound = 1e-4 if name in ("boiling", "inhibited_when_hot") else 1e-6
    assert np.abs(hidden(name, size).state - exact).max() < bound
    assert np.abs(nominal - exact).max() > 1e3 * bound


def test_a_slow_jacket_is_a_third_equation() -> None:
    def duty(T: float, u: float) -> float:
        return 0.01 * u * (1.0 - exp(-700.0 / u)) * (350.0 - T)

    def rates(t: float, x: Array, u: float) -> list[float]:
        dC, dT = balances(x[0], x[1], u)
        return [dC, dT - duty(x[1], u) + x[2], (duty(x[1], u) - x[2]) / 0.08]

    exact = scipy_run(rates, [*START, duty(START[1], COMMAND[0])])
    assert np.abs(hidden("jacket_lag", 0.08).state - exact[:, :2]).max() < 1e-6


def test_a_slow_valve_is_a_third_equation() -> None:
    exact = scipy_run(lambda t, x, u: [*balances(x[0], x[1], x[2]), (u - x[2]) / 0.2], [*START, COMMAND[0]])
    assert np.abs(hidden("valve_lag", 0.2).state - exact[:, :2]).max() < 1e-6


def test_a_wall_takes_up_heat_that_the_contents_lose() -> None:
    def rates(t: float, x: Array, u: float) -> list[float]:
        dC, dT = balances(x[0], x[1], u)
        to_wall = 2.0 * (x[1] - x[2])
        return [dC, dT - 0.1 * to_wall, to_wall]

    exact = scipy_run(rates, [*START, START[1]])
    assert np.abs(hidden("wall_heat_capacity", 0.1).state - exact[:, :2]).max() < 1e-6


def test_a_thermowell_follows_and_the_reactor_does_not_notice() -> None:
    exact = scipy_run(lambda t, x, u: [*balances(x[0], x[1], u), (x[1] - x[2]) / 0.15], [*START, START[1]])
    found = hidden("temperature_lag", 0.15)
    assert np.abs(found.temperature - exact[:, 2]).max() < 1e-6
    assert np.abs(found.state - exact[:, :2]).max() < 1e-6


def test_a_sticking_valve_moves_only_for_more_than_its_size() -> None:
    stands, flows = COMMAND[0], []
    for command in COMMAND:
        stands = command if abs(command - stands) > 6.0 else stands
        flows.append(stands)
    assert 1 < len(set(flows)) < len(set(COMMAND))
    exact = scipy_run(lambda t, x, u: balances(x[0], x[1], u), list(START), np.array(flows))
    assert np.abs(hidden("valve_stiction", 6.0).state - exact).max() < 1e-6


def test_a_valve_with_backlash_comes_within_half_its_size_of_the_command() -> None:
    stands, flows = COMMAND[0], []
    for command in COMMAND:
        stands = min(max(stands, command - 2.0), command + 2.0)
        flows.append(stands)
    exact = scipy_run(lambda t, x, u: balances(x[0], x[1], u), list(START), np.array(flows))
    assert np.abs(hidden("valve_backlash", 4.0).state - exact).max() < 1e-6


def test_a_delayed_analyser_shows_what_scipy_has_in_between_the_rows() -> None:
    found, begin = hidden("concentration_delay", 0.237), np.array(START)
    exact, sampled = np.full(TIME.size, START[0]), TIME - 0.237
    for k in range(TIME.size - 1):
        way = solved(lambda t, x, u: balances(x[0], x[1], u), COMMAND[k], TIME[k], TIME[k + 1], begin)
        inside = (sampled >= TIME[k]) & (sampled < TIME[k + 1])
        if inside.any():
            exact[inside] = way(sampled[inside])[0]
        begin = way(TIME[k + 1])
    assert np.abs(found.concentration - exact)[TIME > 0.237].max() < 1e-8


def test_an_input_that_is_stamped_late_acted_earlier() -> None:
    late = hidden("sample_timing", 0.04).state
    # The rows that the plant feels are those of a record whose input is stamped in time.
    felt = np.unique(np.concatenate([TIME, TIME - 0.04]))
    felt = felt[felt >= 0.0]
    command = COMMAND[np.searchsorted(TIME, felt + 0.04 + 1e-9, "right") - 1]
    in_time = play(Plan(felt, command, start=START)).state[np.searchsorted(felt, TIME)]
    assert np.abs(late - in_time).max() < 1e-8
    assert np.abs(late - play(Plan(TIME, COMMAND, start=START)).state).max() > 0.1


def test_an_interpolated_input_goes_in_straight_lines() -> None:
    found, x = play(Plan(TIME, COMMAND, start=START, interpolated=True)).state, np.array(START)
    for k in range(TIME.size - 1):
        slope = (COMMAND[k + 1] - COMMAND[k]) / 0.1

        def rates(t: float, x: Array, u: float, begin: float = TIME[k], slope: float = slope) -> list[float]:
            return balances(x[0], x[1], u + slope * (t - begin))

        x = solved(rates, COMMAND[k], TIME[k], TIME[k + 1], x)(TIME[k + 1])
        assert np.abs(found[k + 1] - x).max() < 2e-4


def test_sensors_show_what_their_effects_make_of_the_reactor() -> None:
    plain = play(Plan(TIME, COMMAND, start=START))
    C, T = plain.state.T
    assert hidden("temperature_bias", 0.7).temperature == pytest.approx(T + 0.7)
    assert hidden("concentration_bias", 0.01).concentration == pytest.approx(C + 0.01)
    assert hidden("concentration_gain", -0.1).concentration == pytest.approx(0.9 * C)
    assert hidden("bowed_thermometer", 2.0).temperature == pytest.approx(T + 0.02 * (T - 438.54) ** 2)
    assert hidden("analyser_saturation", 0.5).concentration == pytest.approx(C - 0.5 * np.maximum(C - 0.105, 0.0))
    bypassed = hidden("bypass", 0.02)
    assert bypassed.concentration == pytest.approx(0.98 * bypassed.state[:, 0] + 0.02)
    assert bypassed.temperature == pytest.approx(0.98 * bypassed.state[:, 1] + 7.0)


def test_a_thermometer_with_hysteresis_stays_within_half_its_size() -> None:
    found = hidden("thermometer_hysteresis", 2.0)
    off = found.temperature - found.state[:, 1]
    assert np.abs(off).max() == pytest.approx(1.0, abs=1e-9)
    assert off.min() == pytest.approx(-off.max(), abs=0.1)


def test_the_controller_moves_the_valve_in_proportion_to_what_it_sees() -> None:
    noise = np.random.default_rng(5).normal(0.0, 0.3, TIME.size)
    set_point = np.full(TIME.size, 440.0)
    controller = Controller(3.0, 103.0, 90.0, 110.0)
    found = play(Plan(TIME, np.zeros(TIME.size), controller=controller, set_point_K=set_point, measured_noise_K=noise))
    expected = np.clip(103.0 + 3.0 * (found.temperature + noise - 440.0), 90.0, 110.0)
    assert found.qc == pytest.approx(expected)
    replayed = play(Plan(TIME, found.qc, start=(found.state[0, 0], found.state[0, 1])))
    assert np.abs(replayed.state - found.state).max() < 1e-8


def test_process_noise_makes_a_random_walk_of_the_stated_size() -> None:
    """Without reaction dT = -a T dt + sd dW, whose variance is sd^2 / 2a (Ornstein & Uhlenbeck)."""
    time_min, command = 0.1 * np.arange(20_000, dtype=np.float64), np.full(20_000, 100.0)
    quiet, pushed = (
        play(Plan(time_min, command, process_sd=(0.0, sd), seed=4, start=(0.964, 353.55))).state for sd in (0.0, 0.05)
    )
    off = (pushed - quiet)[1000:, 1]
    # a: q/V + K2 qc (1 - exp(-K3/qc)) - 200 k0 C E/T^2 exp(-E/T), the last being the reaction's share
    a = 1.0 + 0.999 - 200.0 * 7.2e10 * 0.964 * 1e4 / 353.5**2 * exp(-1e4 / 353.5)
    # Correlated over 1/a, 1 900 min hold some 1 700 independent values: the sd is known to 1.7 %.
    assert np.std(off) == pytest.approx(0.05 / np.sqrt(2.0 * a), rel=0.06)


@pytest.mark.parametrize("name", reactor.EFFECTS)
def test_of_size_zero_an_effect_does_nothing(name: str) -> None:
    plain = play(Plan(TIME, COMMAND, start=START))
    found = hidden(name, 0.0)
    assert found.state == pytest.approx(plain.state, abs=1e-9)
    assert found.concentration == pytest.approx(plain.concentration, abs=1e-9)
    assert found.temperature == pytest.approx(plain.temperature, abs=1e-9)


def test_a_step_between_two_rows_sets_in_there() -> None:
    course = HiddenCourse("step", 2.0, onset_min=2.537)
    found = play(Plan(TIME, COMMAND, {"feed_temperature": course}, start=START)).state
    split = np.sort(np.append(TIME, 2.537))
    command = COMMAND[np.searchsorted(TIME, split + 1e-9, "right") - 1]
    before = play(Plan(split, command, start=START)).state
    rest = split >= 2.537
    start = before[np.flatnonzero(rest)[0]]
    after = play(
        Plan(split[rest], command[rest], {"feed_temperature": HiddenCourse("constant", 2.0)}, start=tuple(start))
    ).state
    assert np.abs(found[TIME > 2.537] - after[1:]).max() < 1e-8
    assert np.abs(found[TIME < 2.537] - before[split < 2.537]).max() < 1e-8
