"""Changes of level within an incident: chance raises the stated share of them, also where a plant wanders."""

import numpy as np
import pytest
from scipy.signal import lfilter

from reactorwatch.arrays import Array
from reactorwatch.spc.level_change import CHANCE, LevelChange

ROWS = 20


def wandering(coefficient: float, rows: int, signals: int, rng: np.random.Generator) -> Array:
    """Autoregressions in their stationary state."""
    shocks = rng.standard_normal((rows + 500, signals))
    return np.asarray(lfilter([1.0], [1.0, -coefficient], shocks, axis=0)[500:])


def largest_share(test: LevelChange, values: Array) -> float:
    """Largest change relative to its limit."""
    test.start()
    changes = np.abs([test.update(row) for row in values.tolist()])
    return float(np.max(changes / np.array(test.limits)))


@pytest.mark.parametrize("coefficient", [0.0, 0.9, 0.985])
@pytest.mark.parametrize(("rows", "signals"), [(400, 8), (1000, 2)])
def test_chance_raises_a_change_in_at_most_the_stated_share_of_incidents_as_long_as_the_training(
    coefficient: float, rows: int, signals: int
) -> None:
    rng, runs = np.random.default_rng(3), 150
    records = [wandering(coefficient, 2 * rows, signals, rng) for _ in range(runs)]
    raised = sum(largest_share(LevelChange.learn(item[:rows], ROWS), item[rows:]) > 1.0 for item in records)
    assert raised <= 3.0 + CHANCE * runs  # one and a half are expected; five have a chance of a hundredth


def test_the_limit_is_that_of_pickands_where_all_is_known() -> None:
    """P = 3 n u phi(u) / w for n rows: with the true variance 2 / w of white noise and n = 100,000 rows."""
    n = 100_000
    limit = LevelChange.learn(np.random.default_rng(0).standard_normal((n, 1)), ROWS).limits[0]
    u = limit / np.sqrt(2.0 / ROWS)
    assert 3.0 * n / ROWS * u * np.exp(-0.5 * u * u) / np.sqrt(2.0 * np.pi) == pytest.approx(CHANCE, rel=0.5)


def test_a_lasting_step_is_seen_and_an_outlier_or_a_missing_signal_is_none() -> None:
    rng = np.random.default_rng(1)
    test = LevelChange.learn(rng.standard_normal((400, 2)), ROWS)
    values = rng.standard_normal((200, 2))
    values[50, 0], values[80:95, 1] = 9.0, np.nan
    assert largest_share(test, values) < 1.0
    values[120:, 1] += 4.0
    assert largest_share(test, values) > 1.0


def test_a_signal_without_enough_rows_of_training_or_that_never_moved_is_not_tested() -> None:
    rng = np.random.default_rng(2)
    values = rng.standard_normal((400, 3))
    values[:350, 1], values[:, 2] = np.nan, 5.0
    test = LevelChange.learn(values, ROWS)
    assert [np.isfinite(limit) for limit in test.limits] == [True, False, False]
    assert LevelChange.learn(values[:30], ROWS).limits == [np.inf] * 3
