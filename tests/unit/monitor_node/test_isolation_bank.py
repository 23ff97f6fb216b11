"""The linearised bank promises what the filters of the models with a cause in them keep."""

import numpy as np
import pytest

from monitor_node.isolation.causes import CAUSES
from monitor_node.isolation.glr_scan import Bank, Scan, spread_onsets
from monitor_node.isolation.hypothesis import Hypothesis
from monitor_node.isolation.segment import Stretch
from monitor_node.isolation.window import Window, window_of
from reactorwatch.kalman.ekf import Filter, NoiseLevels
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.profiles import RAMP, STEP, Profile
from tests.unit.monitor_node.faulty import ONSET_MIN, SENSORS, rows_of

NOISY = NoiseLevels((0.002, 0.3), (0.002, 0.5))


def scanned(noise: NoiseLevels, period_min: float = 0.1) -> tuple[Window, Scan]:
    process_sd = dict(zip("CT", noise.process_sd, strict=True))
    rows = rows_of(seed=1, after_min=0.0, begin_min=30.0, process_noise_sd=process_sd, period_min=period_min)
    window = window_of(rows, Filter(cstr(), noise))
    assert window is not None
    return window, Bank(cstr(), noise, CAUSES).scan(window)[1]


@pytest.fixture(scope="module")
def quiet() -> tuple[Window, Scan]:
    return scanned(SENSORS)


@pytest.fixture(scope="module")
def noisy() -> tuple[Window, Scan]:
    return scanned(NOISY)


def check_promise(effect: Effect, profile: Profile, window: Window, scan: Scan, noise: NoiseLevels) -> None:
    """Against signatures by differences of the filter that knows the cause, for a size that hardly shows."""
    onset = int(np.searchsorted(scan.onset_min, ONSET_MIN - 5.0))
    while not np.any(np.isclose(window.time_min, scan.onset_min[onset])):  # of one that lies on a row
        onset += 1
    onset_min = float(scan.onset_min[onset])
    cause, shape = CAUSES.index(effect), (STEP, RAMP).index(profile)
    b, size = scan.information[onset, shape, cause], scan.size[onset, shape, cause]
    hypothesis = Hypothesis(cstr(), noise, effect, profile)
    begin, rows = int(np.searchsorted(window.time_min, onset_min)) - 5, window.time_min.size
    little = 0.02 / np.sqrt(b)
    stretch = Stretch(window, begin, rows, Filter(cstr(), noise))
    none, up = (hypothesis.loss(stretch, by, onset_min).w for by in (0.0, little))
    down = hypothesis.loss(stretch, -little, onset_min).w if effect.lower < 0 else 2 * none - up
    signature = (down - up) / (2 * little)
    assert np.sum(signature**2) == pytest.approx(b, rel=0.03)
    expected = np.sum(signature * none) / b
    assert size == pytest.approx(np.clip(expected, effect.lower, effect.upper), abs=0.05 / np.sqrt(b))


@pytest.mark.parametrize("profile", [STEP, RAMP], ids=["step", "ramp"])
@pytest.mark.parametrize("effect", CAUSES, ids=[effect.name for effect in CAUSES])
def test_the_bank_promises_what_a_small_size_does(
    effect: Effect, profile: Profile, quiet: tuple[Window, Scan], noisy: tuple[Window, Scan]
) -> None:
    check_promise(effect, profile, *quiet, SENSORS)
    check_promise(effect, profile, *noisy, NOISY)


def test_it_does_so_for_an_onset_between_two_rows(quiet: tuple[Window, Scan]) -> None:
    """About: what lies between the signatures of two rows is not quite that of an onset between them."""
    window, scan = quiet
    place = int(np.searchsorted(scan.onset_min, ONSET_MIN - 1.0))
    while abs(scan.onset_min[place] % 0.1 - 0.05) > 1e-6:
        place += 1
    for effect in CAUSES:
        if effect.location.endswith("sensor"):
            continue  # to them it is the same as an onset at the next row
        b = scan.information[place, 0, CAUSES.index(effect)]
        hypothesis, little = Hypothesis(cstr(), SENSORS, effect, STEP), 0.02 / np.sqrt(b)
        rows, onset_min = window.time_min.size, float(scan.onset_min[place])
        stretch = Stretch(window, rows - 30, rows, Filter(cstr(), SENSORS))
        none, up = (hypothesis.loss(stretch, by, onset_min).w for by in (0.0, little))
        assert np.sum((none - up) ** 2) / little**2 == pytest.approx(b, rel=0.05)


def test_it_does_so_for_rows_that_are_far_apart() -> None:
    window, scan = scanned(SENSORS, period_min=0.5)
    for effect in CAUSES:
        check_promise(effect, STEP, window, scan, SENSORS)


def test_a_fault_ends_the_early_scan_where_it_stands_out() -> None:
    rows = rows_of("temperature_bias:step:3", seed=2, after_min=5.0)
    window = window_of(rows, Filter(cstr(), SENSORS))
    assert window is not None
    early, whole = Bank(cstr(), SENSORS, CAUSES).scan(window)
    assert ONSET_MIN < window.time_min[early.rows - 1] < ONSET_MIN + 0.3
    assert whole.rows == window.time_min.size
    assert np.max(whole.ratio) > np.max(early.ratio) > 60.0


def test_candidate_onsets_are_dense_where_they_are_new() -> None:
    onsets = spread_onsets(20, 600)
    assert onsets[0] == 20
    assert onsets[-1] == 599
    apart, age = np.diff(onsets), 600 - onsets[1:]
    assert np.all(apart > 0)
    assert np.all(apart[age <= 16] == 1)
    assert np.all(apart <= age / 16 + 1)
    assert spread_onsets(30, 31).tolist() == [30]
