"""The cause is named, with its size and onset; twins share; what is none of these is unknown.

Fits of single causes to a window: sizes, onsets between rows, and what is possible.
A residual of the best cause is detected, and errors of the trained noise are not taken for one.
"""

from collections.abc import Iterable
from dataclasses import replace
from math import nan, sqrt

import casadi as ca
import numpy as np
import pytest

from monitor_node.alarms.alarms import SuspectedCause
from monitor_node.causes.isolation import (
    PROCESS,
    SENSOR,
    UNKNOWN,
    Fitter,
    Isolation,
    causes_of,
    misfit,
)
from monitor_node.causes.scan import Candidate, GlrScan, scan_candidates
from monitor_node.causes.window import Row, Window, window_of
from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.profiles import EndedRamp, Ramp, Step
from reactorwatch.kalman.batch import StepBudget
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.model import ProcessModel, variable
from reactorwatch.records.record import MINUTE_NS
from tests.unit.monitor_node.faulty import ONSET_MIN, SENSORS, rows_of

CAUSES = causes_of(cstr())

GROSS = (
    ("feed_temperature", 4.0),
    ("feed_concentration", -0.024),
    ("feed_flow", 0.06),
    ("reaction_rate", -0.1),
    ("activation_energy", 0.004),
    ("reaction_heat", 0.024),
    ("heat_transfer", -0.6),
    ("heat_loss", 0.028),
    ("coolant_temperature", -4.0),
    ("coolant_flow", -0.04),
    ("temperature_bias", 5.0),
    ("concentration_bias", 0.034),
    ("concentration_gain", -0.36),
)


@pytest.fixture(scope="module")
def isolation() -> Isolation:
    return Isolation(cstr(), SENSORS)


def suspects_of(isolation: Isolation, rows: Iterable[Row]) -> list[SuspectedCause]:
    isolation.fitter.progress = None
    return isolation.suspects(list(rows))


def of_cause(suspects: list[SuspectedCause], cause: str) -> SuspectedCause:
    return next(item for item in suspects if item.cause == cause)


def test_the_list_of_gross_faults_has_every_cause_in_it() -> None:
    assert [cause for cause, _ in GROSS] == [effect.name for effect in CAUSES]


def test_gross_faults_are_named_after_twenty_minutes(isolation: Isolation) -> None:
    """Of 96 such runs 91 % were, and a twin came first in the others; of 13 at least 10 are with a chance of 97 %."""
    named = 0
    for seed, (cause, size) in enumerate(GROSS):
        suspects = suspects_of(isolation, rows_of(f"{cause}:step:{size}", seed=seed, after_min=20.0))
        assert sum(item.probability for item in suspects) == pytest.approx(1.0, abs=1e-9)
        found = of_cause(suspects, cause)
        named += suspects[0] is found
        assert found.profile == "step"
        assert found.kind == (SENSOR if cause.startswith(("temperature_bias", "concentration")) else PROCESS)
        assert suspects[0].kind == found.kind
        assert abs(found.size - size) < 5 * found.size_sd
        assert found.size == pytest.approx(size, rel=0.1)
        assert abs(found.onset_ns / MINUTE_NS - ONSET_MIN) < 5 * found.onset_sd_min
        assert found.onset_sd_min < 0.1
    assert named >= 10


@pytest.mark.parametrize(
    ("cause", "size", "noticed"),
    [("temperature_bias", 0.55, 1.0), ("concentration_bias", -0.0036, 1.0), ("coolant_flow", -0.01, 1.0)],
)
def test_small_faults_of_sensor_and_process_are_distinguished(
    isolation: Isolation, cause: str, size: float, noticed: float
) -> None:
    """Two standard deviations of the sensor, and a hundredth of the coolant."""
    for seed in (1, 2):
        suspects = suspects_of(isolation, rows_of(f"{cause}:step:{size}", seed=seed, after_min=20.0))
        kind = of_cause(suspects, cause).kind
        assert sum(item.probability for item in suspects if item.kind == kind) > 0.8
        found = of_cause(suspects, cause)
        assert abs(found.size - size) < 4 * found.size_sd
        assert abs(found.onset_ns / MINUTE_NS - ONSET_MIN) < noticed


def test_causes_that_imitate_each_other_share_the_probability(isolation: Isolation) -> None:
    """A little less coolant, warmer coolant and a warmer feed differ by a thousandth of what they do."""
    suspects = suspects_of(isolation, rows_of("coolant_flow:step:-0.0045", seed=3, after_min=10.0))
    shares = [
        of_cause(suspects, cause).probability for cause in ("coolant_flow", "coolant_temperature", "feed_temperature")
    ]
    assert max(shares) < 3 * min(shares) + 0.3
    assert min(shares) > 0.03
    assert max(shares) < 0.8


def test_a_drift_is_distinguished_from_a_step(isolation: Isolation) -> None:
    fault = f"temperature_bias:ramp:5@{ONSET_MIN}min,end={ONSET_MIN + 50}min"
    suspects = suspects_of(isolation, rows_of(fault, seed=3, after_min=20.0))
    found = suspects[0]
    assert (found.cause, found.profile) == ("temperature_bias", "ramp")
    assert abs(found.size - 5.0 * 20.0 / 50.0) < 5 * found.size_sd
    assert found.size == pytest.approx(2.0, rel=0.1)
    assert abs(found.onset_ns / MINUTE_NS - ONSET_MIN) < 4 * found.onset_sd_min


def test_where_nothing_is_wrong_no_cause_is_likely(isolation: Isolation) -> None:
    """In 40 such runs the likeliest cause had 0.1 on average, and more than a half in one."""
    likeliest = []
    for seed in range(6):
        suspects = suspects_of(isolation, rows_of(seed=seed, after_min=0.0))
        assert suspects[0].cause == UNKNOWN
        likeliest.append(suspects[1].probability)
    assert np.mean(likeliest) < 0.2


@pytest.mark.parametrize(
    "faults",
    [
        ("temperature_bias:step:2", "concentration_bias:step:-0.02"),
        (f"temperature_bias:step:2@{ONSET_MIN}min", "temperature_bias:step:-2@63min"),
        (f"feed_temperature:sine:4@{ONSET_MIN}min,period=7min",),
    ],
)
def test_what_no_single_cause_explains_is_unknown(isolation: Isolation, faults: tuple[str, ...]) -> None:
    suspects = suspects_of(isolation, rows_of(*faults, seed=3, after_min=10.0))
    assert (suspects[0].cause, suspects[0].kind) == (UNKNOWN, "")
    assert suspects[0].probability > 0.5
    assert (suspects[0].size, suspects[0].onset_ns) == (0.0, 0)


def spoiled(rows: list[Row], seed: int) -> list[Row]:
    """With spikes in two of a hundred values, and as many missing."""
    rng = np.random.default_rng(seed)
    found: list[Row] = []
    for time_min, flow, values in rows:
        dice = rng.random((2, 2))
        y = [value + size * (die < 0.02) for value, size, die in zip(values, (-0.05, 8.0), dice[0], strict=True)]
        found.append((time_min, flow, [nan if die < 0.02 else value for value, die in zip(y, dice[1], strict=True)]))
    return found


def test_spikes_are_no_fault_and_hide_none(isolation: Isolation) -> None:
    suspects = suspects_of(isolation, spoiled(rows_of(seed=1, after_min=0.0), 1))
    assert suspects[0].cause == UNKNOWN
    assert suspects[1].probability < 0.2
    found = suspects_of(isolation, spoiled(rows_of("reaction_rate:step:-0.1", seed=1, after_min=20.0), 5))[0]
    assert found.cause == "reaction_rate"
    assert found.probability > 0.8
    assert found.onset_ns / MINUTE_NS == pytest.approx(ONSET_MIN, abs=0.1)


def test_it_follows_from_the_rows_and_from_when_it_was_asked_before_but_hardly_from_that(isolation: Isolation) -> None:
    rows = rows_of("feed_flow:step:0.06", seed=6, after_min=10.0)
    at_once = suspects_of(isolation, rows)
    found = []
    for _ in range(2):
        isolation.fitter.progress = None
        for count in (621, 641):
            isolation.suspects(rows[:count])
        found.append(isolation.suspects(rows))
    assert found[0] == found[1]
    assert [(item.cause, item.profile) for item in found[0]] == [(item.cause, item.profile) for item in at_once]
    for now, once in zip(found[0], at_once, strict=True):
        assert now.probability == pytest.approx(once.probability, abs=0.01)
        if now.cause != UNKNOWN:
            assert abs(now.size - once.size) < 0.1 * once.size_sd
            assert abs(now.onset_ns / MINUTE_NS - once.onset_ns / MINUTE_NS) < 0.1 * once.onset_sd_min


def test_of_too_few_rows_nothing_is_known(isolation: Isolation) -> None:
    rows = rows_of(seed=7, after_min=0.0)
    for count in (0, 1, 20):
        suspects = suspects_of(isolation, rows[:count])
        assert [(item.cause, item.probability) for item in suspects] == [(UNKNOWN, 1.0)]


def test_where_nothing_is_measured_nothing_is_known(isolation: Isolation) -> None:
    rows = rows_of("temperature_bias:step:2", seed=7, after_min=5.0)
    blind: list[Row] = [(time_min, flow, (nan, nan)) for time_min, flow, _ in rows]
    assert [item.cause for item in suspects_of(isolation, blind)] == [UNKNOWN]
    assert [item.cause for item in suspects_of(isolation, rows[:20] + blind[20:])] == [UNKNOWN]
    assert suspects_of(isolation, blind[:100] + rows[100:]) == suspects_of(isolation, rows[100:])


def test_a_few_rows_after_a_fault_the_answer_is_open_and_of_one_kind_later(isolation: Isolation) -> None:
    fault = "coolant_flow:step:-0.04"
    early, late = (suspects_of(isolation, rows_of(fault, seed=8, after_min=after)) for after in (0.4, 5.0))
    assert early[0].probability < 0.6
    assert of_cause(early, "coolant_flow").probability > 0.02
    assert sum(item.probability for item in late if item.kind == PROCESS) > 0.8


def test_rows_before_a_gap_or_a_clock_that_went_back_do_not_count(isolation: Isolation) -> None:
    rows = rows_of("temperature_bias:step:2", seed=9, after_min=10.0)
    expected = suspects_of(isolation, rows[300:])
    assert expected[0].cause == "temperature_bias"
    elsewhere = [(time_min - 500.0, flow, (0.5, 400.0)) for time_min, flow, _ in rows[:100]]
    assert suspects_of(isolation, elsewhere + rows[300:]) == expected
    assert suspects_of(isolation, rows[400:600] + rows[300:]) == expected


def test_a_missing_input_is_taken_to_be_as_it_was(isolation: Isolation) -> None:
    rows = rows_of("temperature_bias:step:2", seed=10, after_min=5.0)
    missing: list[Row] = [(t, flow if place % 10 == 0 else (nan,), y) for place, (t, flow, y) in enumerate(rows)]
    assert suspects_of(isolation, missing) == suspects_of(isolation, rows)


@pytest.mark.parametrize("place", [0, 1])
def test_one_sensor_is_enough_to_find_a_fault_of_the_process(isolation: Isolation, place: int) -> None:
    rows = rows_of("coolant_flow:step:-0.04", seed=11, after_min=20.0)
    seen = [(t, flow, [value if index == place else nan for index, value in enumerate(y)]) for t, flow, y in rows]
    suspects = suspects_of(isolation, seen)
    assert sum(item.probability for item in suspects if item.kind == PROCESS) > 0.9
    found = of_cause(suspects, "coolant_flow")
    assert found.size == pytest.approx(-0.04, rel=0.1)


def test_in_a_noisy_process_and_slow_samples_too() -> None:
    noise = NoiseLevels((0.002, 0.3), (0.002, 0.5))
    isolation = Isolation(cstr(), noise)
    rows = rows_of("temperature_bias:step:4", seed=12, after_min=20.0, process_noise_sd={"C": 0.002, "T": 0.5})
    found = suspects_of(isolation, rows)[0]
    assert found.cause == "temperature_bias"
    assert abs(found.size - 4.0) < 4 * found.size_sd
    slow = rows_of("temperature_bias:step:4", seed=12, after_min=40.0, period_min=0.5)
    found = suspects_of(Isolation(cstr(), SENSORS), slow)[0]
    assert found.cause == "temperature_bias"
    assert abs(found.onset_ns / MINUTE_NS - ONSET_MIN) < 0.5


class NewState(Effect):
    """Brings a state that the model does not have."""

    name = "new_state"
    label = "a new state"
    location = "reaction"
    unit = "1"
    lower = 0.0
    upper = 1.0

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        lag = variable("lag", "1", (-1.0, 1.0), 1.0, "a lag")
        return ProcessModel(
            model.name,
            (*model.states, lag),
            model.inputs,
            model.parameters,
            (*model.rhs, (size - lag.symbol)),
            model.outputs,
            model.clock,
            model.breakpoints,
        )


def test_only_effects_of_the_process_without_states_of_their_own_are_suspected() -> None:
    sensors = [item for item in CAUSES if item.location.endswith("sensor") and item.name != "concentration_bias"]
    isolation = Isolation(replace(cstr(), effects=(*sensors, NewState())), SENSORS)
    suspects = suspects_of(isolation, rows_of("concentration_bias:step:0.02", seed=14, after_min=5.0))
    assert {item.cause for item in suspects} <= {"temperature_bias", "concentration_gain", UNKNOWN}


def window_with(fault: str, seed: int = 1, after_min: float = 5.0) -> Window:
    window = window_of(rows_of(fault, seed=seed, after_min=after_min, begin_min=40.0), Filter(cstr(), SENSORS))
    assert window is not None
    return window


def fits_of(window: Window, budget: StepBudget | None = None) -> list[Candidate]:
    scans = GlrScan(cstr(), SENSORS, CAUSES).scan(window)
    return Fitter(cstr(), SENSORS, CAUSES).fit(window, *scans, budget)


@pytest.mark.parametrize("size", [2.0, 30.0])
def test_the_size_of_a_bias_is_found_however_large_it_is(size: float) -> None:
    best = fits_of(window_with(f"temperature_bias:step:{size}"))[0]
    assert (best.effect.name, best.profile) == ("temperature_bias", Step)
    assert best.size_sd == pytest.approx(0.3 / sqrt(50), rel=0.2)
    assert abs(best.parameters[0] - size) < 4 * best.size_sd


def test_the_onset_of_a_sensors_step_is_the_middle_between_two_rows() -> None:
    """It is seen at the second of them, no matter when between them it came."""
    best = fits_of(window_with("temperature_bias:step:5"))[0]
    assert best.onset_min == pytest.approx(60.05)
    assert best.onset_sd_min == pytest.approx(0.1 / sqrt(12.0), rel=0.01)


def test_the_onset_of_a_large_fault_of_the_process_is_found_between_two_rows() -> None:
    fits = fits_of(window_with("coolant_flow:step:-0.05", after_min=20.0))
    best = next(item for item in fits if item.effect.name == "coolant_flow")
    assert best.parameters[0] == pytest.approx(-0.05, rel=0.05)
    assert abs(best.onset_min - ONSET_MIN) < 4 * best.onset_sd_min < 0.2


def test_sizes_stay_possible_and_none_begins_at_nothing() -> None:
    window = window_with("heat_transfer:step:-0.8", after_min=2.0)
    scan = GlrScan(cstr(), SENSORS, CAUSES).scan(window)[0]
    for item in [*scan_candidates(CAUSES, scan, window), *fits_of(window)]:
        assert item.effect.lower <= item.parameters[0] <= item.effect.upper
        assert item.parameters[0] != 0.0


def test_an_ended_ramp_has_the_mean_of_its_values_in_each_interval() -> None:
    """A ramp from 2.03 to 5.07 min; a thousand points an interval tell the mean."""
    times = np.asarray(0.1 * np.arange(100), dtype=np.float64)
    parameters = np.array([3.0, 2.03, 5.07])
    signal = EndedRamp(times).signal(parameters)
    fine = np.linspace(0.0, times[-1], 99_001)
    values = 3.0 * np.clip((fine - 2.03) / 3.04, 0.0, 1.0)
    means = 0.5 * (values[1:] + values[:-1]).reshape(99, 1000).mean(axis=1)
    np.testing.assert_allclose(signal.interval_mean[:-1], means, atol=1e-6)
    np.testing.assert_allclose(signal.sample_value, values[::1000], atol=1e-9)


def test_a_drift_that_has_ended_is_a_ramp_of_its_final_size() -> None:
    """A bias that grows by 3 K within 5 min, and stays for 15."""
    fault = f"temperature_bias:ramp:3@{ONSET_MIN}min,end={ONSET_MIN + 5.0}min"
    best = fits_of(window_with(fault, after_min=20.0))[0]
    assert (best.effect.name, best.profile) == ("temperature_bias", EndedRamp)
    assert abs(best.parameters[0] - 3.0) < 4 * best.size_sd
    assert best.parameters[2] == pytest.approx(ONSET_MIN + 5.0, abs=0.5)


def test_an_ongoing_ramp_and_a_step_have_no_end() -> None:
    for fault, profile in (
        (f"temperature_bias:ramp:6@{ONSET_MIN}min,end={ONSET_MIN + 40.0}min", Ramp),
        ("temperature_bias:step:3", Step),
    ):
        assert fits_of(window_with(fault, after_min=20.0))[0].profile is profile


ROWS = 1300


def noise(seed: int) -> Array:
    return np.asarray(np.random.default_rng(seed).standard_normal((ROWS, 2)))


def evidence(w: Array) -> float:
    return misfit(w, np.ones(w.shape, dtype=bool)).log_evidence


@pytest.mark.parametrize("scale", [0.94, 1.0, 1.06])
def test_white_noise_is_no_residual_even_if_the_training_found_its_variance_a_tenth_too_small(scale: float) -> None:
    assert max(evidence(scale * noise(seed)) for seed in range(5)) < 1.0


def test_a_slow_deviation_a_third_as_large_as_the_noise_is_a_residual() -> None:
    slow = 0.35 * np.sin(np.arange(ROWS) / 30.0)[:, None]
    assert evidence(noise(1) + slow) > 5.0


def test_noise_half_as_large_again_is_a_residual() -> None:
    assert evidence(1.5 * noise(1)) > 5.0


def test_without_measurements_there_is_no_residual() -> None:
    w = np.zeros((ROWS, 2))
    assert misfit(w, np.zeros(w.shape, dtype=bool)).log_evidence <= 0.0
    assert misfit(w[:0], np.zeros((0, 2), dtype=bool)).log_evidence <= 0.0
