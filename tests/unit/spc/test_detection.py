"""The sizes of deviations that charts detect in time are those that they detect, by running the charts."""

from math import sqrt

import numpy as np
import pytest
from scipy.signal import lfilter

from reactorwatch.spc.detection import POWER, Detector, error_factor, smallest_sizes

ROWS = 100


def share_seen(chart: Detector, path: np.ndarray, size: float, rows: int, runs: int = 2000) -> float:
    """Share of runs with an alarm within some rows of a unit path of one signal times a size."""
    generator = np.random.default_rng(5)
    noise = generator.normal(size=(runs, 300 + rows))
    noise[:, 300:] += size * path[:rows]
    unit = sqrt(chart.weight / (2.0 - chart.weight))
    average = lfilter([chart.weight / unit], [1.0, chart.weight - 1.0], noise, axis=1)[:, 300:]
    beyond = np.abs(average) > chart.level
    count, window = chart.rule
    counts = lfilter(np.ones(window), [1.0], beyond.astype(float), axis=1)
    return float(np.mean(((counts >= count) & beyond).any(axis=1)))


SHAPES = {
    "a shift": np.ones(ROWS),
    "a rise over twenty rows": np.minimum(np.arange(1, ROWS + 1) / 20.0, 1.0),
    "a jump that fades": np.exp(-np.arange(ROWS) / 15.0),
    "one that comes and goes": 1.0 + np.sin(np.arange(ROWS) / 8.0),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    "chart",
    [
        Detector((0,), np.eye(1), 1.0, 2.9, (3, 5)),
        Detector((0,), np.eye(1), 0.1, 5.2),
        Detector((0,), np.eye(1), 0.02, 5.0),
    ],
    ids=["three of five", "quick average", "slow average"],
)
def test_a_step_of_the_stated_size_is_seen_in_nine_of_ten_runs(chart: Detector, shape: str) -> None:
    """A factor of 1.15 to either side is far from it."""
    path = SHAPES[shape]
    size = float(smallest_sizes(path[None, None, :, None], [chart], [ROWS], 0.0)[0, 0])
    assert share_seen(chart, path, size / 1.15, ROWS) < POWER < share_seen(chart, path, 1.15 * size, ROWS)


def test_beyond_the_rows_that_were_computed_the_deviation_stays_as_it_was() -> None:
    chart = Detector((0,), np.eye(1), 0.1, 5.2)
    size = float(smallest_sizes(np.ones((1, 1, ROWS, 1)), [chart], [2000], 0.0)[0, 0])
    path = np.ones(2000)
    assert share_seen(chart, path, size / 1.15, 2000, 400) < POWER < share_seen(chart, path, 1.15 * size, 2000, 400)


def test_a_ramp_is_stated_by_the_size_that_it_reaches_in_a_day() -> None:
    """A day has 2,000 rows here; the response to a ramp is the sum of responses to steps."""
    chart, day = Detector((0,), np.eye(1), 0.1, 5.2), 2000
    size = float(smallest_sizes(np.ones((1, 1, ROWS, 1)), [chart], [day], day)[0, 0])
    path = np.arange(1, day + 1) / day
    assert share_seen(chart, path, size / 1.15, day, 400) < POWER < share_seen(chart, path, 1.15 * size, day, 400)


def test_of_several_charts_the_most_sensitive_counts() -> None:
    quick, slow = Detector((0,), np.eye(1), 1.0, 4.0), Detector((0,), np.eye(1), 0.1, 5.0)
    paths = np.ones((1, 1, ROWS, 1))
    alone = [smallest_sizes(paths, [chart], [ROWS], 0.0)[0, 0] for chart in (quick, slow)]
    assert smallest_sizes(paths, [quick, slow], [ROWS], 0.0)[0, 0] == pytest.approx(min(alone), rel=1e-3)


def test_what_does_nothing_is_never_seen() -> None:
    chart = Detector((0,), np.eye(1), 0.1, 5.0)
    assert np.isinf(smallest_sizes(np.zeros((1, 1, ROWS, 1)), [chart], [ROWS], 0.0)).all()
    assert np.isinf(smallest_sizes(np.ones((1, 1, ROWS, 1)), [], [ROWS], 0.0)).all()


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_limits_of_errors_with_exponential_tails_are_crossed_no_more_often_than_promised(correlation: float) -> None:
    """100 trainings of 1,000 rows and 10,000 rows after each, in which each chart may be crossed once.

    Normal limits are crossed ten times as often, or more.
    """
    rng, arl0, rows = np.random.default_rng(3), 1e4, 1000
    charts = [Detector((0,), np.eye(1), 1.0, 3.89), Detector((0,), np.eye(1), 0.1, 3.2)]
    normal, wide = np.zeros(2), np.zeros(2)
    for _ in range(100):
        errors = lfilter([1.0], [1.0, -correlation], rng.laplace(size=11_000))
        e = errors / errors[:rows].std()
        factor = error_factor(e[:rows, None], charts, arl0)
        for i, chart in enumerate(charts):
            average = lfilter([chart.weight], [1.0, chart.weight - 1.0], e) / sqrt(chart.weight / (2.0 - chart.weight))
            largest = np.abs(average[rows:]).reshape(-1, 100).max(axis=1) / chart.level  # a cluster is one event
            normal[i] += np.count_nonzero(largest > 1.0)
            wide[i] += np.count_nonzero(largest > factor)
    assert np.all(wide < 1.2 * 100)
    assert normal[0 if correlation == 0.0 else 1] > 10 * wide.max()
