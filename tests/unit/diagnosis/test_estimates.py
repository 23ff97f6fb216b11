"""Intervals of onsets and of an effect's own constants; the extended model holds the diagnosed causes."""

import json
from math import log

import numpy as np
import pytest

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.estimates import WITHIN_ROW, convert_to_run_minutes, extended_model, refine
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, Decay, FittedProfile, PiecewiseLinear, Ramp, Sine, Step
from reactorwatch.diagnosis.record_checks import make_run as of_record
from reactorwatch.diagnosis.result import NAMED, Cause, Estimate
from reactorwatch.diagnosis.search.search import Search
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.library.cstr import EFFECTS, SideReaction, WallHeatCapacity, cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record
from tests.hidden_effect.catalogue import named
from tests.hidden_effect.draw import draw
from tests.hidden_effect.excitation import NAMED_CIRCUMSTANCES
from tests.unit.diagnosis.runs import make_run, record_of
from tests.unit.process.effect_named import effect_of

PERIOD_MIN = 0.1


def step_of(cause: str, size: float, onset_min: float, begun_min: float) -> tuple[Estimate, Estimate, float]:
    """Onset and size of a step in a plant, fitted from another onset; and the onset's standard deviation by the fit."""
    run = make_run(f"{cause}:step:{size}@{onset_min}min", rows=600)
    search = Search(cstr(), EFFECTS, run, (1e-4, 1e-2))
    effect = effect_of(cause)
    hypothesis = Hypothesis(search.filter((effect,)), (Step(run.time_min),))
    fitted = search.fit(hypothesis, (np.array([size, begun_min]),))
    search.update_noise(fitted)
    fitted = search.refit(fitted)
    by_fit = np.sqrt(np.diag(hypothesis.covariance(run, fitted.fit)))
    best, (sds,) = refine(search, fitted, [by_fit])
    size_of, onset = best.fit.parameters[0].tolist()
    return (
        Estimate(onset, sds[1], "min"),
        Estimate(size_of, sds.get(0, float(by_fit[0])), effect.unit),
        float(by_fit[1]),
    )


@pytest.mark.parametrize("run", [1, 2])
@pytest.mark.parametrize(("after_min", "begins"), [(0.9, True), (1.1, False)])
def test_an_onset_within_two_standard_deviations_of_a_run_s_beginning_is_none(
    run: int, after_min: float, *, begins: bool
) -> None:
    time_min = np.concatenate([np.arange(100.0, 160.0), np.arange(60.0)])
    record = Record(time_min, {"qc": np.zeros(120)}, "two.csv", runs=np.repeat([0, 1], 60))
    onset_min = record.continuous_min[record.run_starts[run - 1]] + after_min
    parameters = {"size": Estimate(1.0, 0.1, "K"), "onset": Estimate(onset_min, 0.5, "min")}
    cause = Cause(cause="T.bias", profile="step", label="bias", location="T", parameters=parameters)
    (found,) = convert_to_run_minutes([cause], record)
    assert (found.from_beginning, found.run) == (begins, run)


@pytest.mark.parametrize("onset_min", [30.005, 30.05, 30.095])
def test_the_interval_of_a_sensor_s_onset_ends_at_neighbouring_rows(onset_min: float) -> None:
    """A time that is uniform in an interval has the interval's length over the root of 12 as its standard deviation."""
    onset, _, _ = step_of("temperature_bias", 4.0, onset_min, 30.3)
    assert onset.value == pytest.approx(30.05, abs=0.02)
    assert onset.sd == pytest.approx(PERIOD_MIN / np.sqrt(12.0), rel=0.2)


def test_the_interval_of_a_lag_s_onset_ends_at_moves_of_the_input() -> None:
    """The input moves every minute: within one nothing shows when the valve became slow."""
    onset, _, _ = step_of("valve_lag", 0.2, 30.35, 30.35)
    assert onset.value == pytest.approx(30.5, abs=0.15)
    assert onset.sd == pytest.approx(1.0 / np.sqrt(12.0), rel=0.25)


def test_a_lag_is_found_from_an_onset_that_is_far_off() -> None:
    """The start is a local optimum ten minutes away."""
    onset, _, _ = step_of("valve_lag", 0.2, 30.35, 20.35)
    assert onset.value == pytest.approx(30.5, abs=0.15)


def test_the_interval_of_a_sticking_valve_spans_the_sizes_with_the_same_response() -> None:
    """The interval of its size holds the truth, and is not without bounds."""
    onset, size, _ = step_of("valve_stiction", 3.0, 30.35, 30.35)
    assert abs(size.value - 3.0) < 2.0 * size.sd < 1.0
    assert abs(onset.value - 30.35) < 2.0 * onset.sd < 10.0


def test_an_onset_of_which_the_likelihood_has_two_humps_may_be_at_either() -> None:
    """Held to the likelihood on a fine grid: here half a minute apart, with a valley of 3.5 between them."""
    effect = next(item for item in named() if item.name == "wall_heat_capacity")
    hidden = draw(31_100_016, (effect,), NAMED_CIRCUMSTANCES["medium"])
    size, onset_min = hidden.courses[0].size, hidden.courses[0].onset_min
    run = of_record(hidden.record, cstr())
    search = Search(cstr(), EFFECTS, run, (1e-4, 1e-2))
    ekf = search.filter(tuple(item for item in EFFECTS if item.name == effect.name))
    hypothesis = Hypothesis(ekf, (Step(run.time_min),))
    fitted = search.fit(hypothesis, (np.array([size, onset_min + 0.4]),))
    search.update_noise(fitted)
    fitted = search.refit(fitted)
    best, (sds,) = refine(search, fitted, [np.sqrt(np.diag(hypothesis.covariance(run, fitted.fit)))])
    sd, (found, estimate, *constants) = sds[1], best.fit.parameters[0].tolist()
    grid = np.arange(estimate - 1.0, estimate + 1.0, 0.02)
    losses = np.array([hypothesis.evaluate(run, (np.array([found, onset, *constants]),)).loss for onset in grid])
    likelihood = np.exp(losses.min() - losses)
    spread = np.sqrt(np.sum(likelihood * (grid - estimate) ** 2) / np.sum(likelihood))
    assert sd == pytest.approx(spread, rel=0.15)
    assert abs(estimate - onset_min) < 2.0 * sd


def test_a_smooth_onset_is_left_to_the_fit() -> None:
    """A leak's onset shows in the mean of a row: an interval is by the curvature, but no finer than part of a row."""
    onset, _, by_fit = step_of("coolant_flow", -0.05, 30.35, 30.35)
    assert onset.sd == pytest.approx(max(by_fit, WITHIN_ROW * PERIOD_MIN), rel=0.35)
    assert onset.value == pytest.approx(30.35, abs=3.0 * by_fit)


NOISE = Noise((0.002, 0.3), (0.001, 0.1))


def fitted(fault: str) -> tuple[Hypothesis, float, np.ndarray]:
    """The side reaction's hypothesis, its cost for constants and its parameters, on a record with a fault."""
    run = of_record(record_of(*([fault] if fault else []), rows=900), cstr())
    hypothesis = Hypothesis(FaultFilter(cstr(), (SideReaction(),), NOISE), (Constant(run.time_min),))
    fit = hypothesis.fit(run, [np.array([0.1]) if not fault else np.array([0.3, 12000.0, 60.0])])
    return hypothesis, hypothesis.constants_evidence(run, fit), fit.parameters[0]


def test_constants_that_the_record_determines_are_found_and_charged_by_their_share_of_the_prior() -> None:
    hypothesis, cost, (size, E2, heat) = fitted("side_reaction:constant:0.4,E2=11000K,heat=30")
    assert hypothesis.n_parameters == 3
    assert (size, E2, heat) == pytest.approx((0.4, 11000.0, 30.0), rel=0.2)
    assert 4.0 < cost < 2 * log(4000 / 20) + 2 * log(100 / 0.5)


def test_constants_without_information_stay_at_their_nominal_values_and_cost_nothing() -> None:
    _, cost, (size, E2, heat) = fitted("")
    assert size < 0.02
    assert abs(E2 - 15000.0) < 4000.0
    assert abs(heat - 100.0) < 100.0
    assert cost < 1.0


@pytest.mark.parametrize(
    ("fault", "truth"),
    [
        ("side_reaction:constant:0.3,E2=9000K,heat=250", {"size": 0.3, "E2": 9000.0, "heat": 250.0}),
        ("side_reaction:constant:0.3,E2=19000K,heat=-40", {"size": 0.3, "E2": 19000.0, "heat": -40.0}),
        ("wall_heat_capacity:constant:0.4,exchange=0.7", {"size": 0.4, "exchange": 0.7}),
    ],
)
def test_an_effect_with_other_constants_is_named_with_them(fault: str, truth: dict[str, float]) -> None:
    found = diagnose(record_of(fault, rows=2500), cstr())
    (cause,) = found.causes
    assert (found.verdict, cause.cause) == (NAMED, fault.partition(":")[0])
    for name, value in truth.items():
        stated = cause.parameters[name]
        assert abs(stated.value - value) < 4 * stated.sd, name
        assert stated.sd < 0.25 * abs(value), name


def test_every_constant_is_within_its_bounds_and_has_a_prior() -> None:
    for effect in (SideReaction(), WallHeatCapacity()):
        for item in effect.constants:
            assert all(item.lower < value < item.upper for value in (item.value, *item.start_values))
            assert item.sd > 0.0


TIMES_MIN = np.arange(0.0, 100.05, 0.1)


def cause_of(name: str, profile: FittedProfile, fitted: list[float]) -> Cause:
    parameters = {key: Estimate(value, 0.0, "1") for key, value in profile.profile_values(np.array(fitted)).items()}
    return Cause(cause=name, profile=profile.name, label=name, location="coolant", parameters=parameters)


def deviation(model: ProcessModel, times_min: list[float]) -> list[float]:
    """m(t) of a bias of the thermometer, from what it shows of 440 K."""
    found = []
    shown = model.function("model")
    for time in times_min:
        _, y = shown([0.1, 440.0], [100.0], model.values(), time, time)
        found.append(float(y[1]) - 440.0)
    return found


@pytest.mark.parametrize(
    ("profile", "fitted"),
    [
        (Step(TIMES_MIN), [1.5, 33.33]),
        (Ramp(TIMES_MIN), [-2.0, 20.0]),
        (Decay(TIMES_MIN), [3.0, 10.0, 25.0]),
        (Sine(TIMES_MIN), [0.6, -0.8, 17.0]),
        (PiecewiseLinear(TIMES_MIN, 5), [0.0, 1.0, -3.0, 0.5, 2.0]),
        (PiecewiseLinear(TIMES_MIN, 4), [0.0, 0.0, 0.0, 0.0]),
    ],
)
def test_the_written_profile_is_the_fitted_course(profile: FittedProfile, fitted: list[float]) -> None:
    written = extended_model(cstr(), EFFECTS, [cause_of("temperature_bias", profile, fitted)])
    model = parse_extended_model(json.dumps(written)).build()
    expected = profile.signal(np.array(fitted)).sample_value
    places = [0, 150, 333, 334, 600, 1000]
    np.testing.assert_allclose(deviation(model, TIMES_MIN[places].tolist()), expected[places], atol=1e-9)


def test_a_curve_at_the_bounds_of_its_effect_can_be_read_again() -> None:
    written = extended_model(
        cstr(), EFFECTS, [cause_of("coolant_flow", PiecewiseLinear(TIMES_MIN, 3), [-0.99, 0.3, 4.0])]
    )
    values = parse_extended_model(json.dumps(written)).effects[0].values
    assert [values["size"] * values[f"value_{number}"] for number in (1, 2, 3)] == pytest.approx([-0.99, 0.3, 4.0])


def test_effects_that_are_in_the_model_already_stay() -> None:
    first = extended_model(cstr(), EFFECTS, [cause_of("heat_loss", Step(TIMES_MIN), [0.1, 5.0])], 17)
    model = parse_extended_model(json.dumps(first)).build()
    both = extended_model(model, EFFECTS, [cause_of("heat_loss", Step(TIMES_MIN), [0.2, 50.0])], 17)
    assert both["effects"] == ["heat_loss:step:0.1@5min", "heat_loss:step:0.2@50min"]
    assert both["zero_ns"] == 17
