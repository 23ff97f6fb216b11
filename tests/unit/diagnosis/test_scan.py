"""Onsets and magnitudes in which the loss has no slope, knots of curves, and delayed measurements."""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.augmented_model import effective_timing, shift_measurements
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import MOST_STEPS, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, Decay, FittedProfile, PiecewiseLinear, Ramp, Step
from reactorwatch.diagnosis.fitting.scan import (
    GRID,
    fit_hypothesis,
    refine_onset,
    search_coarse,
    search_fine,
    select_knots,
)
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis, Search
from reactorwatch.process.library.cstr import EFFECTS, cstr
from tests.unit.diagnosis.runs import make_run
from tests.unit.process.effect_named import effect_of

TIMES: Array = np.cumsum(np.append(0.0, np.random.default_rng(3).choice([0.05, 0.1, 0.2], 100)))


@pytest.mark.parametrize("size", [0.02, 0.1, 0.45])
@pytest.mark.parametrize("after_row_min", [0.0, 0.01, 0.049])
def test_what_sets_in_at_once_grows_as_fast_as_the_clock_goes_until_it_is_all_there(
    size: float, after_row_min: float
) -> None:
    onset = TIMES[40] + after_row_min
    growth, ahead = effective_timing(Step(TIMES).signal(np.array([size, onset])), TIMES)[:2]
    np.testing.assert_allclose(ahead, np.clip(TIMES - onset, 0.0, size), rtol=0, atol=1e-12)
    np.testing.assert_allclose(growth[:-1] * np.diff(TIMES), np.diff(ahead), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("kind", "parameters"), [(Ramp, [0.4, 2.0]), (Decay, [0.4, 2.03, 1.0])])
def test_what_grows_slowly_is_as_large_as_it_is(kind: type[FittedProfile], parameters: list[float]) -> None:
    signal = kind(TIMES).signal(np.array(parameters))
    np.testing.assert_array_equal(effective_timing(signal, TIMES).sample_value, signal.sample_value)


@pytest.mark.parametrize("start_min", [37.5, 40.0, 44.2])
def test_an_onset_that_no_slope_leads_to_is_found_from_another_stretch_between_two_moves(start_min: float) -> None:
    """The input moves every minute, and the sensors tell each stretch from the next."""
    run = make_run("sample_timing:step:0.06@40.53min", rows=900)
    timing = effect_of("sample_timing")
    hypothesis = Hypothesis(FaultFilter(cstr(), (timing,), Noise((0.002, 0.3), (0.0, 0.0))), (Step(run.time_min),))
    truth = hypothesis.evaluate(run, (np.array([0.06, 40.53]),))
    best = refine_onset(run, hypothesis, hypothesis.fit(run, (np.array([0.05, start_min]),)), MOST_STEPS)
    assert best.loss < truth.loss + 0.1
    assert best.parameters[0][1] == pytest.approx(40.53, abs=1.0)


STICKS = effect_of("valve_stiction")
NOISE = Noise((0.002, 0.3), (0.0, 0.0))


@pytest.mark.parametrize(("size", "onset_min"), [(6.0, 150.23), (5.3, 212.07), (3.65, 211.78), (7.33, 175.97)])
def test_an_onset_that_no_slope_leads_to_is_found(size: float, onset_min: float) -> None:
    run = make_run(f"valve_stiction:step:{size}@{onset_min}min", rows=3000)
    hypothesis = Hypothesis(FaultFilter(cstr(), (STICKS,), NOISE), (Step(run.time_min),))
    truth = hypothesis.evaluate(run, (np.array([size, onset_min]),))
    coarse = search_coarse(run, hypothesis, hypothesis.evaluate(run, (np.array([6.3, 40.0]),)))
    found = search_fine(run, hypothesis, coarse)
    assert found.loss <= truth.loss + 1e-6
    # When it began to stick shows only in where it stands from the next move on that it does not follow.
    after = slice(int(10.0 * onset_min) + 100, None)
    np.testing.assert_allclose(found.innovations.x[after, 2], truth.innovations.x[after, 2], atol=0.01)


def test_a_size_is_found_between_the_two_moves_that_it_lies_between() -> None:
    run = make_run("valve_stiction:constant:4.0", rows=1500)
    hypothesis = Hypothesis(FaultFilter(cstr(), (STICKS,), NOISE), (Constant(run.time_min),))
    truth = hypothesis.evaluate(run, (np.array([4.0]),))
    found = fit_hypothesis(run, hypothesis, (np.array([1.5]),))
    assert found.loss <= truth.loss + 1e-6
    assert found.parameters[0][0] == pytest.approx(4.0, abs=0.5)


@pytest.mark.parametrize("onset_min", [0.0, 12.34, 99.95, 149.9])
def test_a_filter_that_resumes_where_a_later_onset_makes_no_difference_gives_the_same_output(onset_min: float) -> None:
    run = make_run("valve_stiction:step:6.0@50.23min", rows=1500)
    hypothesis = Hypothesis(FaultFilter(cstr(), (STICKS,), NOISE), (Step(run.time_min),))
    later = hypothesis.evaluate(run, (np.array([6.0, 149.9]),))
    numbers = (np.array([6.0, onset_min]),)
    whole, rest = hypothesis.evaluate(run, numbers), hypothesis.evaluate(run, numbers, later)
    assert rest.loss == whole.loss
    for one, other in zip((rest.w, *rest.innovations), (whole.w, *whole.innovations), strict=True):
        np.testing.assert_array_equal(one, other)


LAST_MIN = 149.9


def curve(search: Search, cause: str, knots: int) -> FittedHypothesis:
    effect = effect_of(cause)
    profile = PiecewiseLinear(search.run.time_min, knots)
    hypothesis = Hypothesis(search.filter((effect,)), (profile,))
    return search.fit(hypothesis, (np.full(knots, 0.1 * effect.typical),))


def search_of(shares: list[float]) -> Search:
    """Through knots at even distances from the first row to the last."""
    times = np.linspace(0.0, LAST_MIN, len(shares))
    fault = ",".join(f"{time:.6f}min={share}" for time, share in zip(times, shares, strict=True))
    return Search(cstr(), EFFECTS, make_run(f"coolant_flow:free:-0.06,{fault}", rows=1500), (1e-4, 1e-2))


@pytest.mark.parametrize("shares", [[0.1, 1.0, 0.2, 0.9], [0.0, 1.0, 0.1, 0.7, 0.2, 0.9, 0.1]])
@pytest.mark.parametrize("begun", [12, 23])
def test_it_has_the_knots_of_the_truth(shares: list[float], begun: int) -> None:
    search = search_of(shares)
    fitted = curve(search, "coolant_flow", begun)
    search.update_noise(fitted)
    fitted = search.refit(fitted)
    grid = PiecewiseLinear(search.run.time_min, GRID)
    profile, parameters = select_knots(grid, search.run, fitted.hypothesis, fitted.fit, 0)
    assert profile.n_linear == len(shares)
    np.testing.assert_allclose(parameters, -0.06 * np.array(shares), atol=0.003)


def test_no_knot_is_added_or_taken_away_at_a_loss() -> None:
    search = search_of([0.1, 1.0, 0.2, 0.9])
    fitted = curve(search, "coolant_flow", 12)
    search.update_noise(fitted)
    fitted = search.refit(fitted)
    with_selected_knots = search.with_selected_knots(fitted)
    assert with_selected_knots.bic < fitted.bic - 6.0 * np.log(search.run.values)  # of eight knots that are not needed
    assert search.with_selected_knots(with_selected_knots) is with_selected_knots


SENSORS = Noise((0.002, 0.3), (0.0, 0.0))
DELAY = effect_of("concentration_delay")


def test_each_value_is_where_it_was_true_and_inputs_are_held() -> None:
    run = Run(np.arange(4.0), np.array([[1.0], [2.0], [3.0], [4.0]]), np.arange(8.0).reshape(4, 2))
    by = shift_measurements(run, run.inputs, np.array([True]), 0, np.full(4, 0.25))
    assert by.run.time_min.tolist() == [0.0, 0.75, 1.0, 1.75, 2.0, 2.75, 3.0]
    np.testing.assert_array_equal(by.run.measured[:, 0], [0.0, 2.0, np.nan, 4.0, np.nan, 6.0, np.nan])
    np.testing.assert_array_equal(by.run.measured[:, 1], [1.0, np.nan, 3.0, np.nan, 5.0, np.nan, 7.0])
    assert by.run.inputs[:, 0].tolist() == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0]


@pytest.mark.parametrize("delay_min", [0.1, 0.27])
def test_with_the_right_delay_the_innovations_are_those_of_a_prompt_sensor(delay_min: float) -> None:
    run = make_run(f"concentration_delay:constant:{delay_min}", rows=1500)
    profile = Constant(run.time_min)
    late = FaultFilter(cstr(), (DELAY,), SENSORS)
    losses = [late.evaluate(run, [profile.signal(np.array([delay]))])[0] for delay in (0.0, delay_min)]
    _, w, _ = late.evaluate(run, [profile.signal(np.array([delay_min]))])
    assert losses[1] < losses[0] - 1000.0
    assert np.nanmean(w[100:] ** 2) == pytest.approx(1.0, abs=0.08)  # 2800 values: 0.027 by chance


def test_after_a_break_it_begins_with_all_that_is_measured() -> None:
    run = make_run("concentration_delay:constant:0.3", rows=600)
    broken = Run(run.time_min, run.inputs, run.measured, breaks=(300,))
    profile = Constant(run.time_min)
    _, w, found = FaultFilter(cstr(), (DELAY,), SENSORS).evaluate(broken, [profile.signal(np.array([0.3]))])
    assert np.all(np.isnan(found.prediction[300]))
    assert np.all(np.isfinite(w[305:]))
    assert np.max(np.abs(w[305:])) < 6.0


def test_what_was_true_before_a_break_is_held_against_no_delay() -> None:
    """In three rows of twenty the analyser shows values of before; the right delay is likeliest nevertheless."""
    run = make_run("concentration_delay:constant:0.3", rows=1200)
    broken = Run(run.time_min, run.inputs, run.measured, breaks=tuple(range(20, 1200, 20)))
    profile = Constant(run.time_min)
    late = FaultFilter(cstr(), (DELAY,), SENSORS)
    losses = {
        delay: late.evaluate(broken, [profile.signal(np.array([delay]))])[0] for delay in (0.1, 0.2, 0.3, 0.4, 0.5)
    }
    assert min(losses, key=lambda delay: losses[delay]) == 0.3
