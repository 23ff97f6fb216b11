"""The proposed input: within limits under every rival, better than what the plant would do anyway, or none."""

from dataclasses import replace

import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.diagnosis.experiment.design import FEWEST, PATTERN_ROWS, propose_experiment
from reactorwatch.diagnosis.experiment.inputs import (
    HOLDS_ROWS,
    QUIET_ROWS,
    InputRange,
    check_limits,
    initial_sequences,
    limits_of,
)
from reactorwatch.diagnosis.experiment.predictions import Predictions
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant
from reactorwatch.diagnosis.result import Experiment
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.records.record import Record
from tests.unit.diagnosis.linear_tank import NOISE, Gain, Shift, explained, tank
from tests.unit.diagnosis.linear_tank import record as tank_record

SENSORS = Noise((0.002, 0.3), (0.0, 0.0))
LIMITS = {"qc": (95.0, 112.0), "T": (428.0, 450.0)}
NAMED = {effect.name: effect for effect in EFFECTS}
NARROW = {"kind": "random-steps", "low": 102.41, "high": 104.41}


@pytest.fixture(scope="module")
def run() -> Run:
    found = simulate_record(PlantConfig(seed=4, faults=("coolant_flow:constant:-0.02",), scenario=NARROW), 600)
    measured = np.stack([found.columns["C"], found.columns["T"]], axis=1)
    return Run(found.time_min, found.columns["qc"][:, None], measured)


def alternative(run: Run, **sizes: float) -> FittedHypothesis:
    """Some causes that are there all the time."""
    effects = tuple(NAMED[name] for name in sizes)
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
    ("limits", "said"),
    [
        ({"p": (1.0, 2.0)}, "limits must be of qc, C, T, got p"),
        ({"T": (455.0, 425.0)}, r"limits of T must be two rising numbers, got 455\.\.425"),
        ({"T": (425.0, float("nan"))}, "limits of T must be two rising numbers"),
        ({"qc": (-5.0, 110.0)}, r"limits of qc must be within 0\.\.500 l/min, got -5\.\.110"),
    ],
)
def test_limits_that_cannot_be_meant_are_refused_in_a_line(limits: dict[str, tuple[float, float]], said: str) -> None:
    with pytest.raises(InputError, match=said):
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
