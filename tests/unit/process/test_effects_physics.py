"""Effects against the physics written out by hand and integrated by scipy, with a far smaller tolerance."""

from math import exp

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.process.library.cstr import OPERATING_STATE, cstr
from reactorwatch.process.library.cstr_operation import LevelControl
from reactorwatch.process.profiles import RAMP
from reactorwatch.process.simulate import Simulator
from tests.unit.process.by_hand import duty, run
from tests.unit.process.effect_named import effect_of, extend_cstr

TIMES: Array = np.cumsum(np.append(0.0, np.random.default_rng(8).choice([0.05, 0.1, 0.2], 150)))
FLOWS = np.repeat(np.random.default_rng(9).uniform(92, 108, 31), 5)[: TIMES.size]
START = np.array(OPERATING_STATE)
ERROR = np.array([2e-6, 2e-3])
"""mol/l and K: a hundredth of what the sensors' noise is, or less."""


def reactor(x: Array, qc: float, q: float = 100, V: float = 100, rate: float = 1.0) -> list[float]:
    """The balances as the literature has them, by volume, and the rate times a factor."""
    C, T = x[:2].tolist()
    speed = rate * C * exp(-1e4 / T)
    return [
        q / V * (1.0 - C) - 7.2e10 * speed,
        q / V * (350 - T) + 1.44e13 * speed + 100 / V * duty(T, qc),
    ]


def simulate(cause: str, size: float) -> Array:
    return Simulator(extend_cstr(cause, size)).run(TIMES, FLOWS, START).outputs


@pytest.mark.parametrize("size", [-0.3, 0.2])
def test_reaction_order(size: float) -> None:
    truth = run(lambda t, x, qc: reactor(x, qc, rate=(x[0] / 0.1) ** size), START, TIMES, FLOWS)
    assert np.all(np.abs(simulate("reaction_order", size) - truth) < ERROR)


def test_side_reaction() -> None:
    def rates(t: float, x: Array, qc: float) -> list[float]:
        dC, dT = reactor(x, qc)
        side = 0.5 * exp(-15e3 * (1 / x[1] - 1 / 438.54)) * x[0]
        return [dC - side, dT + 100 * side]

    assert np.all(np.abs(simulate("side_reaction", 0.5) - run(rates, START, TIMES, FLOWS)) < ERROR)


@pytest.mark.parametrize("size", [-0.1, 0.2])
def test_volume(size: float) -> None:
    truth = run(lambda t, x, qc: reactor(x, qc, V=100 * (1 + size)), START, TIMES, FLOWS)
    assert np.all(np.abs(simulate("volume", size) - truth) < ERROR)


def test_volume_with_a_level_of_its_own_is_where_the_level_comes_to_rest() -> None:
    model = extend_cstr("volume", 0.1, LevelControl().extend(cstr()))
    states = Simulator(model).run(TIMES, FLOWS, np.array([*START, 110.0])).states
    truth = run(lambda t, x, qc: reactor(x, qc, V=110), START, TIMES, FLOWS)
    assert np.all(np.abs(states[:, :2] - truth) < ERROR)
    assert states[:, 2] == pytest.approx(110.0)


def test_bypass() -> None:
    inside = run(lambda t, x, qc: reactor(x, qc, q=95), START, TIMES, FLOWS)
    assert np.all(np.abs(simulate("bypass", 0.05) - (0.95 * inside + 0.05 * np.array([1.0, 350.0]))) < ERROR)


@pytest.mark.parametrize("first", ["bypass", "feed_temperature"])
def test_what_passes_by_is_the_feed_as_it_is(first: str) -> None:
    second = "feed_temperature" if first == "bypass" else "bypass"
    sizes = {"bypass": 0.05, "feed_temperature": 8.0}
    model = extend_cstr(second, sizes[second], extend_cstr(first, sizes[first]))
    run_ = Simulator(model).run(TIMES, FLOWS, START)
    np.testing.assert_allclose(run_.outputs, 0.95 * run_.states + 0.05 * np.array([1.0, 358.0]), rtol=1e-12)


@pytest.mark.parametrize("late", [0.02, 0.05])
def test_an_input_that_is_stamped_late_has_acted_before(late: float) -> None:
    """The plant is switched early, and read at the times of the rows; the shortest of them is 0.05 min."""
    found = simulate("sample_timing", late)
    switched = TIMES - late
    between = np.ravel(np.column_stack([switched, TIMES]))
    truth = run(lambda t, x, qc: reactor(x, qc), START, between, np.repeat(FLOWS, 2))
    assert np.all(np.abs(found - truth[1::2]) < ERROR)


def advance_inputs(switched_min: Array) -> Array:
    """Measurements at the rows of a plant in which the input of each row acts from a given time on."""
    between = np.unique(np.concatenate([TIMES, switched_min]))
    flows = FLOWS[np.searchsorted(switched_min, between, side="right") - 1]
    return run(lambda t, x, qc: reactor(x, qc), START, between, flows)[np.searchsorted(between, TIMES)]


@pytest.mark.parametrize("before_min", [0.01, 0.03, 0.3])
def test_inputs_whose_stamps_become_late_act_earlier_from_then_on_and_no_earlier(before_min: float) -> None:
    """It happens so long before an input changes: twice that change is felt at once, or nearly so."""
    late, onset_min = 0.04, TIMES[75] - before_min
    truth = advance_inputs(np.where(onset_min < TIMES, np.maximum(TIMES - late, onset_min), TIMES))
    found = Simulator(extend_cstr("sample_timing", late, onset_min=onset_min)).run(TIMES, FLOWS, START).outputs
    assert np.all(np.abs(found - truth) < ERROR)


def test_inputs_with_ever_later_stamps_act_ever_earlier() -> None:
    """To first order in how fast: the rest is the shift times its growth, here 0.0002 min, times 60 K/min."""
    size, begin, end = 0.04, 5.0, 13.0
    values = {f"sample_timing.{name}": value for name, value in {"size": size, "onset": begin, "end": end}.items()}
    model = effect_of("sample_timing").extend(cstr(), RAMP).with_values(values)
    found = Simulator(model).run(TIMES, FLOWS, START).outputs
    growth = size / (end - begin)
    rising = (TIMES + growth * begin) / (1 + growth)  # is felt what is stamped later by as much as it has grown by then
    truth = advance_inputs(np.where(begin > TIMES, TIMES, np.maximum(rising, TIMES - size)))
    assert np.all(np.abs(found - truth) < [1.2e-5, 0.012])


def test_an_input_that_is_interpolated_is_held_and_stamped_half_a_period_late_to_first_order() -> None:
    """Nine tenths of the difference to a held input that is stamped in time goes away."""
    time_min: Array = 0.1 * np.arange(151.0)
    flows: Array = 100 + 6 * np.sin(time_min)

    def rates(t: float, x: Array, qc: float) -> list[float]:
        return reactor(x, float(np.interp(t, time_min, flows)))

    truth = run(rates, START, time_min, flows)
    late, in_time = (
        Simulator(extend_cstr("sample_timing", size)).run(time_min, flows, START).outputs[30:] - truth[30:]
        for size in (0.05, 0.0)
    )
    assert np.all(np.std(late, axis=0) < 0.1 * np.std(in_time, axis=0))
