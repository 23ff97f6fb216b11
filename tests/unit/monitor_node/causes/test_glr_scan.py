"""The linearised scan predicts what the filters of the models with a cause give."""

import numpy as np
import pytest

from monitor_node.causes.isolation import causes_of
from monitor_node.causes.scan import GlrScan, Scan
from monitor_node.causes.window import BURN_IN_ROWS, Window, window_of
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import FittedProfile, Ramp, Step
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import cstr
from tests.unit.monitor_node.faulty import ONSET_MIN, SENSORS, rows_of

CAUSES = causes_of(cstr())

NOISY = NoiseLevels((0.002, 0.3), (0.002, 0.5))


def scanned(noise: NoiseLevels, period_min: float = 0.1) -> tuple[Window, Scan]:
    process_sd = dict(zip("CT", noise.process_sd, strict=True))
    rows = rows_of(seed=1, after_min=0.0, begin_min=30.0, process_noise_sd=process_sd, period_min=period_min)
    window = window_of(rows, Filter(cstr(), noise))
    assert window is not None
    return window, GlrScan(cstr(), noise, CAUSES).scan(window)[1]


@pytest.fixture(scope="module")
def quiet() -> tuple[Window, Scan]:
    return scanned(SENSORS)


@pytest.fixture(scope="module")
def noisy() -> tuple[Window, Scan]:
    return scanned(NOISY)


def check_promise(effect: Effect, profile: type[FittedProfile], window: Window, scan: Scan, noise: NoiseLevels) -> None:
    """Against signatures by differences of the filter that knows the cause, for a size that hardly shows."""
    onset = int(np.searchsorted(scan.onset_min, ONSET_MIN - 5.0))
    onset_min = float(scan.onset_min[onset]) + 1e-6  # right after a row, which does not show it
    cause, shape = CAUSES.index(effect), (Step, Ramp).index(profile)
    b, size = scan.information[onset, shape, cause], scan.size[onset, shape, cause]
    ekf = FaultFilter(cstr(), (effect,), Noise(noise.measurement_sd, noise.process_sd))
    hypothesis = Hypothesis(ekf, (profile(window.time_min),))
    span = float(window.time_min[-1]) - onset_min if profile is Ramp else 1.0
    little = 0.02 / np.sqrt(b)
    sizes = (0.0, little, -little) if effect.lower < 0 else (0.0, little)
    found = [hypothesis.evaluate(window, (np.array([by * span, onset_min]),)) for by in sizes]
    none, up = (np.nan_to_num(item.w) for item in found[:2])
    down = np.nan_to_num(found[2].w) if effect.lower < 0 else 2 * none - up
    signature = (down - up) / (2 * little)
    assert np.sum(signature**2) == pytest.approx(b, rel=0.03)
    expected = np.sum(signature * none) / b
    assert size == pytest.approx(max(expected, 0.0) if effect.lower == 0.0 else expected, abs=0.05 / np.sqrt(b))


@pytest.mark.parametrize("profile", [Step, Ramp], ids=["step", "ramp"])
@pytest.mark.parametrize("effect", CAUSES, ids=[effect.name for effect in CAUSES])
def test_the_scan_promises_what_a_small_size_does(
    effect: Effect, profile: type[FittedProfile], quiet: tuple[Window, Scan], noisy: tuple[Window, Scan]
) -> None:
    check_promise(effect, profile, *quiet, SENSORS)
    check_promise(effect, profile, *noisy, NOISY)


def test_it_does_so_for_rows_that_are_far_apart() -> None:
    window, scan = scanned(SENSORS, period_min=0.5)
    for effect in CAUSES:
        check_promise(effect, Step, window, scan, SENSORS)


def test_a_fault_ends_the_early_scan_where_it_stands_out() -> None:
    rows = rows_of("temperature_bias:step:3", seed=2, after_min=5.0)
    window = window_of(rows, Filter(cstr(), SENSORS))
    assert window is not None
    early, whole = GlrScan(cstr(), SENSORS, CAUSES).scan(window)
    assert ONSET_MIN < window.time_min[early.rows - 1] < ONSET_MIN + 0.3
    assert whole.rows == window.time_min.size
    assert np.max(whole.ratio) > np.max(early.ratio) > 60.0


def test_a_deviation_may_set_in_after_every_row_but_the_last_from_the_first_onset_on(
    quiet: tuple[Window, Scan],
) -> None:
    window, scan = quiet
    assert scan.onset_min.tolist() == window.time_min[BURN_IN_ROWS:-1].tolist()
    assert scan.rows == window.time_min.size
