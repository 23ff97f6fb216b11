"""Drawn records: the same from the same seed, and each circumstance as specified."""

from dataclasses import replace

import numpy as np
import pytest

from tests.hidden_effect.catalogue import CATALOGUE, OUTSIDE, HiddenEffect
from tests.hidden_effect.courses import Array, HiddenCourse
from tests.hidden_effect.draw import COLDEST_K, HOTTEST_K, LEAST_STRENGTH, CannotHideError, Hidden, draw
from tests.hidden_effect.excitation import MIDDLE_L_MIN, NAMED_CIRCUMSTANCES, Circumstances

SHORT = Circumstances(span_min=60.0)
FEED = CATALOGUE[0]


def noise_of(hidden: Hidden) -> Array:
    """Noise of the sensors in standard deviations, shape (rows, 2); only without missing rows."""
    true = np.stack([hidden.played.concentration, hidden.played.temperature], axis=1)
    shown = np.stack([hidden.record.columns["C"], hidden.record.columns["T"]], axis=1)
    return np.asarray((shown - true) / np.array(hidden.circumstances.noise_sd))


def test_a_seed_gives_the_same_record_again_and_another_one_another() -> None:
    once, again, other = (draw(seed, (FEED,), SHORT) for seed in (5, 5, 6))
    assert all(np.array_equal(once.record.columns[name], again.record.columns[name]) for name in ("qc", "C", "T"))
    assert once.courses[0].size == again.courses[0].size != other.courses[0].size


@pytest.mark.parametrize("effect", [*CATALOGUE, *OUTSIDE], ids=lambda effect: effect.name)
def test_what_is_hidden_shows_has_a_size_of_its_range_and_leaves_the_reactor_on_its_branch(
    effect: HiddenEffect,
) -> None:
    hidden = draw(3, (effect,), replace(SHORT, span_min=100.0))
    assert hidden.causes == (effect.name,)
    assert hidden.strength >= LEAST_STRENGTH
    assert effect.smallest <= abs(hidden.courses[0].size) <= effect.largest
    assert hidden.courses[0].kind in effect.courses
    assert hidden.played.state[:, 1].min() > COLDEST_K
    assert hidden.played.state[:, 1].max() < HOTTEST_K


def test_each_of_two_effects_shows_beside_the_other() -> None:
    hidden = draw(8, (CATALOGUE[3], CATALOGUE[16]), SHORT)
    assert hidden.causes == ("reaction_rate", "temperature_bias")
    assert len(hidden.courses) == 2


def test_what_cannot_show_is_refused() -> None:
    nothing = replace(FEED, smallest=1e-9, largest=2e-9)
    with pytest.raises(CannotHideError, match="shows too little"):
        draw(1, (nothing,), replace(SHORT, span_min=10.0))


def test_without_an_effect_the_noise_is_white_and_of_the_stated_size() -> None:
    off = noise_of(draw(2))
    assert np.std(off, axis=0) == pytest.approx([1.0, 1.0], abs=4.0 / np.sqrt(2 * 7500))
    assert np.mean(off[1:] * off[:-1], axis=0) == pytest.approx([0.0, 0.0], abs=4.0 / np.sqrt(7500))


def test_correlated_noise_has_that_correlation_and_the_same_size() -> None:
    off = noise_of(draw(2, (), NAMED_CIRCUMSTANCES["correlated noise"]))
    assert np.mean(off[1:] * off[:-1], axis=0) == pytest.approx([0.5, 0.5], abs=0.06)
    assert np.std(off, axis=0) == pytest.approx([1.0, 1.0], abs=0.05)


def test_one_row_in_twenty_is_missing_but_never_the_first() -> None:
    record = draw(2, (), NAMED_CIRCUMSTANCES["missing rows"]).record
    # Of 7500 rows 375 are expected to be missing, with a standard deviation of 19.
    assert 7500 - record.rows == pytest.approx(375, abs=76)
    assert record.time_min[0] == 0.0


def test_in_one_row_of_twenty_both_values_are_missing_and_the_flow_is_known() -> None:
    columns = draw(2, (), NAMED_CIRCUMSTANCES["missing values"]).record.columns
    assert np.array_equal(np.isnan(columns["C"]), np.isnan(columns["T"]))
    assert np.isnan(columns["T"]).sum() == pytest.approx(375, abs=76)
    assert np.all(np.isfinite(columns["qc"]))


def test_irregular_rows_come_in_order_and_off_their_times() -> None:
    steps = np.diff(draw(2, (), replace(NAMED_CIRCUMSTANCES["irregular"], span_min=60.0)).record.time_min)
    assert steps.min() > 0.0
    assert steps.max() > 0.15


def test_quantised_values_are_multiples_of_the_resolution() -> None:
    record = draw(2, (), replace(NAMED_CIRCUMSTANCES["quantised"], span_min=60.0)).record
    assert record.columns["T"] % 0.5 == pytest.approx(0.0)
    assert np.unique(np.round(record.columns["C"] / 0.002, 6) % 1.0) == pytest.approx([0.0])


def test_one_value_in_a_hundred_is_far_off() -> None:
    far = np.abs(noise_of(draw(2, (), NAMED_CIRCUMSTANCES["outliers"]))) > 6.0
    assert far.mean() == pytest.approx(0.01, abs=4.0 * np.sqrt(0.01 / far.size))


def test_the_inputs_are_what_they_are_called() -> None:
    flows = {
        name: draw(4, (), replace(NAMED_CIRCUMSTANCES[name], span_min=120.0)).record.columns["qc"]
        for name in ("medium", "narrow", "few steps", "closed loop")
    }
    changes = {name: np.count_nonzero(np.diff(flow)) for name, flow in flows.items()}
    assert changes["medium"] == changes["narrow"] == 119
    assert np.abs(flows["narrow"] - MIDDLE_L_MIN).max() <= 1.0
    assert np.ptp(flows["medium"]) > 15.0
    assert 5 <= changes["few steps"] <= 8
    assert changes["closed loop"] == flows["closed loop"].size - 1


def test_a_plant_that_starts_near_the_unstable_point_lights_and_an_extinguished_one_stays_out() -> None:
    lit, out = (
        draw(2, (), replace(NAMED_CIRCUMSTANCES[name], span_min=60.0)).played.state[:, 1]
        for name in ("wrong branch", "extinguished")
    )
    assert lit[0] < 410.0
    assert lit[-1] > 420.0
    assert out.max() < 365.0


@pytest.mark.parametrize(
    ("course", "expected"),
    [
        (HiddenCourse("constant", 2.0), [2.0, 2.0, 2.0, 2.0]),
        (HiddenCourse("step", 2.0, onset_min=5.0), [0.0, 2.0, 2.0, 2.0]),
        (HiddenCourse("ramp", 2.0, onset_min=5.0, end_min=15.0), [0.0, 0.0, 1.0, 2.0]),
        (HiddenCourse("decay", 2.0, onset_min=5.0, time_constant_min=5.0), [0.0, 0.0, 1.2642411, 1.7293294]),
        (HiddenCourse("sine", 2.0, onset_min=0.0, period_min=20.0), [0.0, 2.0, 0.0, -2.0]),
        (HiddenCourse("pulses", 2.0, onset_min=0.0, period_min=10.0), [2.0, 0.0, 2.0, 0.0]),
    ],
    ids=lambda item: item.kind if isinstance(item, HiddenCourse) else "",
)
def test_courses_match_their_names(course: HiddenCourse, expected: list[float]) -> None:
    times = np.array([0.0, 5.0, 10.0, 15.0])
    assert course.at(times) == pytest.approx(expected, abs=1e-7)


def test_a_free_curve_is_straight_between_its_knots() -> None:
    course = HiddenCourse("free", 3.0, knots_min=np.array([0.0, 10.0, 20.0]), values=np.array([0.0, 3.0, 1.0]))
    assert course.at(np.array([-1.0, 5.0, 10.0, 15.0, 21.0])) == pytest.approx([0.0, 1.5, 3.0, 2.0, 1.0])
