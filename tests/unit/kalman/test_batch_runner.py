"""Filters run as a batch give the output of each alone, to the last bit."""

from collections.abc import Sequence

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.kalman.batch import LEAST_ROWS, FilterRecord, FilterResult, run_together
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.library.cstr import cstr

ROWS = 2 * LEAST_ROWS
LEVELS = [NoiseLevels((1e-3 * (1 + n), 0.2), (1e-4, 0.02 * n)) for n in range(6)]


def record(seed: int, rows: int = ROWS) -> FilterRecord:
    """Record of a drifting plant that does not match the model."""
    rng = np.random.default_rng(seed)
    measured: Array = np.array([0.1, 438.5]) + rng.normal(size=(rows, 2)) * [1e-3, 0.2]
    measured[rng.random(rows) < 0.05] = np.nan
    qc: Array = 103.4 + np.cumsum(rng.normal(size=rows)) * 0.02
    return FilterRecord(np.arange(rows) / 10.0, qc[:, None], measured, gate=6.0)


def same(found: Sequence[FilterResult], expected: Sequence[FilterResult]) -> bool:
    pairs = [pair for of in zip(found, expected, strict=True) for pair in zip(*of, strict=True)]
    return all(np.array_equal(*pair, equal_nan=True) for pair in pairs)


def alone(records: Sequence[FilterRecord]) -> list[FilterResult]:
    return [Filter(cstr(), noise).run(item) for noise, item in zip(LEVELS, records, strict=False)]


def at_once(records: Sequence[FilterRecord]) -> list[FilterResult]:
    filters = [Filter(cstr(), noise) for noise, _ in zip(LEVELS, records, strict=False)]
    return run_together([item.run_batched(of) for item, of in zip(filters, records, strict=True)])


@pytest.mark.parametrize("count", [1, 2, 3, 4, 6])
def test_each_filter_gives_the_output_it_gives_alone(count: int) -> None:
    records = [record(seed) for seed in range(count)]
    assert same(at_once(records), alone(records))


def test_records_of_different_lengths_and_with_gaps_go_together() -> None:
    records = [record(1), record(2, LEAST_ROWS + 200), record(3), record(4)]
    times = records[2].time_min.copy()
    times[700:] += 2.0
    records[2] = FilterRecord(times, records[2].inputs, records[2].measured, gate=6.0)
    assert same(at_once(records), alone(records))


def test_one_that_loses_the_plant_does_not_disturb_the_others() -> None:
    """In the middle of one record something is measured of which no filter can make a number."""
    records = [record(seed) for seed in range(4)]
    measured: Array = records[1].measured.copy()
    measured[1000] = 1e308
    records[1] = FilterRecord(records[1].time_min, records[1].inputs, measured)
    found, expected = at_once(records), alone(records)
    assert np.all(np.isnan(expected[1].prediction[1000]))
    assert same(found, expected)
