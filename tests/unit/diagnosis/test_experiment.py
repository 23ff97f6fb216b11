"""The proposed input: its expected evidence, its limits, and that it decides between the alternatives."""

from dataclasses import replace
from math import exp

import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.arrays import Array
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.experiment.design import FEWEST, PATTERN_ROWS, propose_experiment
from reactorwatch.diagnosis.experiment.inputs import (
    HOLDS_ROWS,
    QUIET_ROWS,
    InputRange,
    check_limits,
    initial_sequences,
    limits_of,
)
from reactorwatch.diagnosis.experiment.predictions import Prediction, Predictions, decision_probability, extrapolate
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, PiecewiseLinear, Ramp, Sine
from reactorwatch.diagnosis.result import NAMED, Experiment
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.records.record import Record
from tests.unit.diagnosis.linear_tank import NOISE, NOISE_SD, PERIOD_MIN, RATE, Gain, Shift, explained, follows, tank
from tests.unit.diagnosis.linear_tank import record as tank_record

SENSORS = Noise((0.002, 0.3), (0.0, 0.0))
LIMITS = {"qc": (95.0, 112.0), "T": (428.0, 450.0)}
BY_NAME = {effect.name: effect for effect in EFFECTS}
NARROW = {"kind": "random-steps", "low": 102.41, "high": 104.41}


@pytest.fixture(scope="module")
def run() -> Run:
    found = simulate_record(PlantConfig(seed=4, faults=("coolant_flow:constant:-0.02",), scenario=NARROW), 600)
    measured = np.stack([found.columns["C"], found.columns["T"]], axis=1)
    return Run(found.time_min, found.columns["qc"][:, None], measured)


def alternative(run: Run, **sizes: float) -> FittedHypothesis:
    """Some causes that are there all the time."""
    effects = tuple(BY_NAME[name] for name in sizes)
    hypothesis = Hypothesis(FaultFilter(cstr(), effects, SENSORS), [Constant(run.time_min)] * len(effects))
    return FittedHypothesis(hypothesis, hypothesis.evaluate(run, [np.array([size]) for size in sizes.values()]), 0.0)


@pytest.fixture(scope="module")
def experiment(run: Run) -> Experiment:
    both = [alternative(run, coolant_flow=-0.02), alternative(run, feed_temperature=1.8)]
    found = propose_experiment(both, run, cstr(), SENSORS, LIMITS)
    assert isinstance(found, Experiment)
    return found


def test_the_input_is_given_by_its_changes_and_stays_within_its_limits(experiment: Experiment) -> None:
    times, levels = np.array(experiment.input).T
    assert experiment.signal == "qc"
    assert times[0] == 0.0
    assert np.all(np.diff(times) > 0.0)
    assert times[-1] < experiment.span_min
    assert experiment.span_min >= 0.1 * FEWEST * PATTERN_ROWS - 1e-9
    assert np.all(np.diff(levels) != 0.0)
    assert levels.min() >= 95.0
    assert levels.max() <= 112.0
    assert np.all(levels == np.round(levels, 1))
    assert experiment.separates == ("coolant_flow", "feed_temperature")
    assert "would decide between wrong gain of the coolant valve and wrong feed temperature" in experiment.why


@pytest.mark.parametrize("fault", ["coolant_flow:constant:-0.02", "feed_temperature:constant:1.8"])
def test_the_plant_does_under_each_rival_what_was_predicted_and_what_its_sensors_show_keeps_the_limits(
    experiment: Experiment, fault: str
) -> None:
    curves = experiment.curves
    assert curves is not None
    driver = Record(curves.time_min, {"qc": curves.level}, "experiment")
    config = PlantConfig(seed=21, faults=(fault,), noise_sd={"C": 0.0, "T": 0.0})
    quiet = simulate_record(config, curves.level.size, driver=driver)
    name = fault.split(":", maxsplit=1)[0]
    for output, close in (("C", 1e-5), ("T", 1e-3)):
        np.testing.assert_allclose(quiet.columns[output], curves.outputs[name][output], atol=close)
        ends = experiment.predicted[name][output]
        assert ends == pytest.approx((quiet.columns[output].min(), quiet.columns[output].max()), abs=close)
    noisy = simulate_record(PlantConfig(seed=21, faults=(fault,)), curves.level.size, driver=driver)
    outside = (noisy.columns["T"] < LIMITS["T"][0]) | (noisy.columns["T"] > LIMITS["T"][1])
    assert np.mean(outside) < 0.002  # three standard deviations away at the most extreme


def test_the_proposed_input_is_more_informative_than_the_same_time_of_random_steps_within_the_limits(
    run: Run, experiment: Experiment
) -> None:
    both = [alternative(run, coolant_flow=-0.02), alternative(run, feed_temperature=1.8)]
    alternatives = Predictions(both, run, cstr(), SENSORS, LIMITS, PATTERN_ROWS)
    found = []
    for seed in range(12):
        levels = np.repeat(np.random.default_rng(seed).uniform(97.0, 110.0, 120), 10)
        runs = alternatives.runs(levels)
        if runs is not None:
            found.append(alternatives.members[1].noncentrality(runs[0]))
    assert len(found) >= 6
    assert experiment.expected_delta_bic * 120.0 / experiment.span_min > 1.5 * max(found)


def test_twins_are_reported_as_such(run: Run) -> None:
    """C measured (1 + m) C is what a feed richer by the factor 1 + m gives, if as much less heat comes of it."""
    m = 0.03
    both = [
        alternative(run, concentration_gain=m),
        alternative(run, feed_concentration=m * 1.0, reaction_heat=1.0 / (1.0 + m) - 1.0),
    ]
    found = propose_experiment(both, run, cstr(), SENSORS, {"qc": (85.0, 112.0), "T": (425.0, 460.0)})
    assert isinstance(found, str)
    assert found.startswith("No experiment with qc can tell wrong gain of the analyser and wrong feed concentration")
    assert "not even in 480 min" in found


def test_a_twin_among_others_does_not_keep_these_from_being_distinguished(run: Run) -> None:
    m = 0.03
    three = [
        alternative(run, concentration_gain=m),
        alternative(run, feed_concentration=m * 1.0, reaction_heat=1.0 / (1.0 + m) - 1.0),
        alternative(run, concentration_bias=m * 0.1),
    ]
    found = propose_experiment(three, run, cstr(), SENSORS, LIMITS)
    assert isinstance(found, Experiment)
    assert set(found.separates) == {"concentration_gain", "feed_concentration+reaction_heat", "concentration_bias"}
    assert "(but not between wrong gain of the analyser and wrong feed concentration with" in found.why
    assert [item.probability > 0.9 for item in found.separations] == [False, True, True]


def test_limits_that_leave_no_room_are_reported_as_such(run: Run) -> None:
    both = [alternative(run, coolant_flow=-0.02), alternative(run, feed_temperature=1.8)]
    found = propose_experiment(both, run, cstr(), SENSORS, {"T": (440.0, 441.0)})
    assert isinstance(found, str)
    assert "leave qc no room to move" in found


def test_nothing_in_it_refers_to_the_reactor() -> None:
    record = tank_record(np.repeat(5.0 + np.random.default_rng(1).uniform(-1.0, 1.0, 60), 10))
    both = [explained(Gain(), 0.02, record), explained(Shift(), 0.1, record)]
    found = propose_experiment(both, record, tank(), NOISE, {"u": (1.0, 9.0), "h": (0.0, 10.0)})
    assert isinstance(found, Experiment)
    assert found.signal == "u"
    levels = np.array(found.input)[:, 1]
    assert levels.min() < 2.0  # the wider, the better
    assert levels.max() > 8.0


@pytest.mark.parametrize(
    ("limits", "stated"),
    [
        ({"p": (1.0, 2.0)}, "limits must be of qc, C, T, got p"),
        ({"T": (455.0, 425.0)}, r"limits of T must be two rising numbers, got 455\.\.425"),
        ({"T": (425.0, float("nan"))}, "limits of T must be two rising numbers"),
        ({"qc": (-5.0, 110.0)}, r"limits of qc must be within 0\.\.500 l/min, got -5\.\.110"),
    ],
)
def test_limits_that_cannot_be_meant_are_refused_in_a_line(limits: dict[str, tuple[float, float]], stated: str) -> None:
    with pytest.raises(InputError, match=stated):
        check_limits(cstr(), limits)


def test_without_limits_they_follow_from_the_record_with_a_margin_but_never_beyond_the_model(run: Run) -> None:
    found = limits_of(run, cstr(), {"T": (430.0, 450.0)})
    assert found["T"] == (430.0, 450.0)
    low, high = found["qc"]
    assert low == pytest.approx(run.inputs.min() - 5.0)  # half the scale, as a quarter of the range is less
    assert high == pytest.approx(run.inputs.max() + 5.0)
    wide = replace(run, inputs=run.inputs * np.linspace(0.0, 4.5, run.time_min.size)[:, None])
    low, high = limits_of(wide, cstr(), {})["qc"]
    assert low == 0.0
    assert high == 500.0


def test_levels_are_short_numbers_within_the_ends() -> None:
    ends = InputRange(97.43, 109.41, 103.42)
    levels = ends.levels(np.linspace(-1.0, 1.0, 201))
    assert np.all(levels == np.round(levels, 1))
    assert (levels[0], levels[100], levels[-1]) == (97.5, 103.4, 109.4)
    tried = list(initial_sequences(PATTERN_ROWS))
    assert len(tried) == 2 * len(HOLDS_ROWS)
    for sequence in tried:
        column = sequence.levels(ends, PATTERN_ROWS)
        assert column.size == PATTERN_ROWS
        assert np.all(column[:QUIET_ROWS] == 103.4)


ROWS = 300
SIZES = (0.02, 0.1)
"""Sizes of the gain and of the shift, which are the same deviation at a level of 5."""


def steps(reach: float, rows: int = ROWS, seed: int = 3) -> Array:
    return np.repeat(5.0 + reach * np.random.default_rng(seed).uniform(-1.0, 1.0, rows // 10), 10)


def alternatives(reach: float) -> tuple[Prediction, Prediction, Run]:
    """The two, and what the first predicts."""
    record = tank_record(steps(1.0))
    resting = np.array([5.0])
    gain, shift = (
        Prediction(item.hypothesis, item.fit, record, resting, 300, 30.0)
        for item in (explained(Gain(), SIZES[0], record), explained(Shift(), SIZES[1], record))
    )
    time_min = gain.start_min + PERIOD_MIN * np.arange(ROWS, dtype=np.float64)
    u = steps(reach)[:, None]
    outputs = gain.predict_outputs(time_min, u)
    assert outputs is not None
    return gain, shift, Run(time_min, u, outputs)


def closed_form(u: Array) -> float:
    """Part of a gain that a shift from any start cannot imitate, by least squares, in units of the noise."""
    truth = follows((1.0 + SIZES[0]) * u, 5.0 * (1.0 + SIZES[0]))
    base = follows(u, 0.0)
    of_start = exp(-RATE * PERIOD_MIN) ** np.arange(u.size)
    of_shift = 1.0 - of_start
    columns = np.column_stack([of_start, of_shift])
    left = (truth - base) - columns @ np.linalg.lstsq(columns, truth - base, rcond=None)[0]
    return float(left @ left) / NOISE_SD**2


@pytest.mark.parametrize("reach", [1.0, 4.0])
def test_of_a_linear_plant_the_expected_evidence_is_the_noncentrality_of_the_likelihood_ratio(reach: float) -> None:
    gain, shift, truth = alternatives(reach)
    np.testing.assert_allclose(
        truth.measured[:, 0], follows((1.0 + SIZES[0]) * truth.inputs[:, 0], 5.0 * (1.0 + SIZES[0])), atol=1e-6
    )
    expected = closed_form(truth.inputs[:, 0])
    assert shift.noncentrality(truth) == pytest.approx(expected, rel=0.02)  # which leaves out the second row
    assert 2.0 * (shift.loss(truth) - gain.own_loss(truth)) == pytest.approx(expected, rel=0.02)
    assert gain.noncentrality(truth) == pytest.approx(0.0, abs=1e-6)


def test_with_noise_the_evidence_scatters_about_its_expectation_as_the_probability_implies() -> None:
    gain, shift, truth = alternatives(4.0)
    expected = 2.0 * (shift.loss(truth) - gain.own_loss(truth))
    profiles = (Constant(truth.time_min),)
    both = [Hypothesis(FaultFilter(tank(), (effect,), NOISE), profiles) for effect in (Gain(), Shift())]
    random, found = np.random.default_rng(8), []
    for _ in range(150):
        noisy = Run(truth.time_min, truth.inputs, truth.measured + NOISE_SD * random.standard_normal((ROWS, 1)))
        losses = [item.fit(noisy, [np.array([size])]).loss for item, size in zip(both, SIZES, strict=True)]
        found.append(2.0 * (losses[1] - losses[0]))
    error = np.std(found) / np.sqrt(len(found))
    assert np.mean(found) == pytest.approx(expected, abs=3.5 * error)
    assert np.std(found) == pytest.approx(2.0 * np.sqrt(expected), rel=3.5 / np.sqrt(2 * len(found)))
    decided, share = np.mean(np.array(found) > 10.0), decision_probability(expected, expected)
    assert decided == pytest.approx(share, abs=3.5 * np.sqrt(share * (1.0 - share) / len(found)))


def test_evidence_that_noise_of_the_process_would_hide_does_not_count() -> None:
    _, shift, truth = alternatives(4.0)
    disturbed = explained(Shift(), SIZES[1], truth)
    disturbed.hypothesis.filter.noise = Noise(NOISE.measurement_sd, (0.1,))
    other = Prediction(disturbed.hypothesis, disturbed.fit, truth, np.array([5.0]), 300, 30.0)
    assert 0.0 < other.noncentrality(truth) < 0.7 * shift.noncentrality(truth)


@pytest.mark.parametrize(("profile", "parameters"), [(Ramp, [2.0, 10.0]), (PiecewiseLinear, [0.0, 1.0, 2.0])])
def test_what_has_set_in_stays_as_large_as_it_was_at_the_end(
    profile: type[Ramp] | type[PiecewiseLinear], parameters: list[float]
) -> None:
    record_min = np.arange(0.0, 50.0, 0.1)
    there = Ramp(record_min) if profile is Ramp else PiecewiseLinear(record_min, 3)
    later, numbers = extrapolate(there, np.array(parameters), np.arange(60.0, 70.0, 0.1), 60.0)
    np.testing.assert_allclose(later.signal(numbers).sample_value, 2.0)


def test_an_oscillation_persists() -> None:
    parameters, later_min = np.array([0.6, -0.8, 7.0]), np.arange(81.3, 95.0, 0.1)
    later, numbers = extrapolate(Sine(np.arange(2.0, 50.0, 0.1)), parameters, later_min, 60.0)
    angle = 2.0 * np.pi * (later_min - 2.0) / 7.0
    np.testing.assert_allclose(later.signal(numbers).sample_value, 0.6 * np.sin(angle) - 0.8 * np.cos(angle), atol=1e-9)


WIDE_LIMITS = {"qc": (95.0, 112.0), "T": (425.0, 455.0)}


@pytest.mark.parametrize(
    ("cause", "size", "alternative", "seed"),
    [
        ("coolant_flow", -0.02, "feed_temperature", 2),
        ("feed_temperature", 1.5, "coolant_flow", 2),
        ("heat_loss", 0.01, "coolant_flow", 2),
        ("reaction_heat", -0.01, "heat_loss", 2),
    ],
)
def test_the_experiment_decides(cause: str, size: float, alternative: str, seed: int) -> None:
    config = PlantConfig(seed=seed, faults=(f"{cause}:step:{size}@60min",), scenario=NARROW)
    open_ = diagnose(simulate_record(config, 1500), cstr(), limits=WIDE_LIMITS)
    listed = {item.cause for item in open_.causes} | {name for item in open_.alternatives for name, _ in item.causes}
    assert {cause, alternative} <= listed
    experiment = open_.experiment
    assert experiment is not None
    assert {cause, alternative} <= set(experiment.separates)
    assert experiment.probability >= 0.9
    assert experiment.expected_delta_bic >= 10.0

    times, levels = np.array(experiment.input).T
    driver = Record(times, {"qc": levels}, "experiment")
    rows = round(experiment.span_min / 0.1)
    config = PlantConfig(seed=100 + seed, faults=(f"{cause}:constant:{size}",))
    measured = simulate_record(config, rows, driver=driver)
    decided = diagnose(measured, cstr())
    assert decided.verdict == NAMED
    assert [item.cause for item in decided.causes] == [cause]
    stated = decided.causes[0].parameters["size"]
    assert abs(stated.value - size) < 4.0 * stated.sd
    assert decided.alternatives == ()
    assert decided.experiment is None
    assert np.mean((measured.columns["T"] < 425.0) | (measured.columns["T"] > 455.0)) < 0.002


def test_where_no_experiment_is_possible_a_remark_states_it_and_nothing_is_proposed() -> None:
    config = PlantConfig(seed=2, faults=("coolant_flow:step:-0.02@60min",), scenario=NARROW)
    found = diagnose(simulate_record(config, 1200), cstr(), limits={"T": (440.0, 440.5)})
    assert found.alternatives
    assert found.experiment is None
    assert "leave qc no room to move" in " ".join(found.remarks)


def test_where_nothing_is_left_open_no_experiment_is_proposed() -> None:
    config = PlantConfig(seed=2, faults=("coolant_flow:step:-0.05@60min",))
    found = diagnose(simulate_record(config, 1200), cstr())
    assert (found.verdict, found.alternatives, found.experiment) == (NAMED, (), None)
    assert not [remark for remark in found.remarks if "xperiment" in remark]
