"""Fits of single causes to a window: sizes, onsets between rows, and what is possible."""

from math import sqrt

import numpy as np
import pytest

from monitor_node.causes.isolation import Fitter, causes_of
from monitor_node.causes.scan import Candidate, GlrScan, scan_candidates
from monitor_node.causes.window import Window, window_of
from reactorwatch.diagnosis.fitting.profiles import EndedRamp, Ramp, Step
from reactorwatch.kalman.batch import StepBudget
from reactorwatch.kalman.ekf import Filter
from reactorwatch.process.library.cstr import cstr
from tests.unit.monitor_node.faulty import ONSET_MIN, SENSORS, rows_of

CAUSES = causes_of(cstr())


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
