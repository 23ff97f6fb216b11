"""How far the clock is ahead, and how fast that grows: no faster than the clock goes."""

import numpy as np
import pytest

from diagnosis.clock_shift import felt
from diagnosis.courses import Course, Decay, Ramp, Step
from reactorwatch.process.model import Array

TIMES: Array = np.cumsum(np.append(0.0, np.random.default_rng(3).choice([0.05, 0.1, 0.2], 100)))


@pytest.mark.parametrize("size", [0.02, 0.1, 0.45])
@pytest.mark.parametrize("after_row_min", [0.0, 0.01, 0.049])
def test_what_sets_in_at_once_grows_as_fast_as_the_clock_goes_until_it_is_all_there(
    size: float, after_row_min: float
) -> None:
    onset = TIMES[40] + after_row_min
    growth, ahead = felt(Step(TIMES).signal(np.array([size, onset])), TIMES)
    np.testing.assert_allclose(ahead, np.clip(TIMES - onset, 0.0, size), rtol=0, atol=1e-12)
    np.testing.assert_allclose(growth[:-1] * np.diff(TIMES), np.diff(ahead), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("kind", "theta"), [(Ramp, [0.4, 2.0]), (Decay, [0.4, 2.03, 1.0])])
def test_what_grows_slowly_is_as_large_as_it_is(kind: type[Course], theta: list[float]) -> None:
    signal = kind(TIMES).signal(np.array(theta))
    np.testing.assert_array_equal(felt(signal, TIMES).at_row, signal.at_row)
