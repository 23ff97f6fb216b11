"""Filters run as a batch give the output of each alone, to the last bit; inputs that changed at an unknown time."""

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.kalman.batch import (
    LEAST_ROWS,
    FilterRecord,
    FilterResult,
    InputUncertainty,
    insert_rows,
    run_together,
)
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.error_dynamics import ErrorLinearization
from reactorwatch.kalman.noise_estimation import fit_noise
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.model import ProcessModel
from tests.unit.kalman.plant import SENSORS, record_of

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


@pytest.mark.parametrize("missing", [1, 2, 5, 40])
def test_inputs_may_have_changed_with_each_missing_row_and_the_one_after_them(missing: int) -> None:
    time_min = np.delete(0.1 * np.arange(60.0), np.arange(7, 7 + missing))
    uncertainty = InputUncertainty.for_missing_rows(
        time_min, np.zeros((time_min.size, 1)), missing * (np.arange(time_min.size) == 7)
    )
    times = [time for time, _ in uncertainty.changes(7)]
    np.testing.assert_allclose(times, 0.1 * np.arange(7, 8 + missing), rtol=1e-12)
    assert np.flatnonzero(uncertainty.rows).tolist() == [7]


@pytest.mark.parametrize("missing", [1, 2, 5])
def test_a_level_is_as_uncertain_as_when_its_valve_opened_and_what_follows_it_with_the_square(missing: int) -> None:
    """dx/dt = u, dz/dt = x: of u since r the level x is u r, and z is u r^2 / 2."""
    model, noise = filling(), NoiseLevels((0.1,), (0.0, 0.0))
    kalman, sure = Filter(model, noise), Filter(model, noise)
    for tanks in (kalman, sure):
        for row in range(50):
            tanks.update(0.1 * row, (0.0,), (5.0,))
    moments, now = (4.9 + 0.1 * np.arange(1, missing + 2)).tolist(), 5.0 + 0.1 * missing
    kalman.update(now, (3.0,), (np.nan,), changes=[(moment, (3.0,)) for moment in moments])
    sure.update(now, (3.0,), (np.nan,))
    open_min = now - np.array(moments)
    by = np.array([3.0 * open_min, 1.5 * open_min**2])
    np.testing.assert_allclose(np.subtract(kalman.state.x, sure.state.x), np.mean(by, axis=1), rtol=1e-9)
    np.testing.assert_allclose(
        np.subtract(kalman.state.P, sure.state.P), np.cov(by, bias=True).ravel(), rtol=1e-6, atol=1e-12
    )


def test_behind_holes_anywhere_innovations_do_not_go_with_the_way_in_which_the_input_changed() -> None:
    """Their standard error is 0.04; with half of the way for a change in its middle those of C go by 0.2."""
    seen: list[Array] = []
    for seed in range(3):
        time_min, qc, measured, _ = with_holes(seed=10 + seed)
        there = np.random.default_rng(seed).random(time_min.size) >= 0.2
        there[0] = True
        missing = missing_of(time_min[there], qc[there])
        uncertainty = InputUncertainty.for_missing_rows(time_min[there], qc[there][:, None], missing)
        found = Filter(cstr(), SENSORS).run(
            FilterRecord(time_min[there], qc[there][:, None], measured[there], uncertainty=uncertainty)
        )
        behind = np.flatnonzero(missing)
        way = np.sign(qc[there][behind] - qc[there][behind - 1])[:, None]
        seen += [*(way * found.normalized[behind])]
    assert len(seen) > 400
    np.testing.assert_allclose(np.mean(seen, axis=0), 0.0, atol=0.12)


def test_the_equations_of_the_errors_expect_of_a_way_in_doubt_what_the_filter_expects() -> None:
    time_min, qc, measured, there = with_holes(seed=7)
    inputs, missing = qc[there][:, None], missing_of(time_min[there], qc[there])
    uncertainty, times, seen = (
        InputUncertainty.for_missing_rows(time_min[there], inputs, missing),
        time_min[there],
        measured[there],
    )
    levels = NoiseLevels(SENSORS.measurement_sd, (1e-4, 0.05))
    found = Filter(cstr(), levels).run(FilterRecord(times, inputs, seen, uncertainty=uncertainty))
    later = slice(1, None)  # the filter begins with the first row
    x, P, residual = (item[later] for item in (found.x, found.P, found.residual))
    errors = ErrorLinearization(cstr(), levels, (), ())
    ways = errors.dynamics(
        times[later], inputs[later], x, P, residual, np.isfinite(residual), None, uncertainty.select(later)
    )
    assert np.count_nonzero(missing) > 200
    np.testing.assert_allclose(ways.w, found.normalized[2:], atol=0.03)


def test_innovations_behind_holes_are_as_large_as_the_filter_states() -> None:
    """Mean squares of 600 and more, whose standard deviation is 0.06; without doubt they are far larger."""
    time_min, qc, measured, there = with_holes(seed=3)
    inputs, missing = qc[there][:, None], missing_of(time_min[there], qc[there])
    uncertainty = InputUncertainty.for_missing_rows(time_min[there], inputs, missing)
    doubted = Filter(cstr(), SENSORS).run(
        FilterRecord(time_min[there], inputs, measured[there], uncertainty=uncertainty)
    )
    behind = np.flatnonzero(missing)
    assert behind.size > 300
    assert np.mean(doubted.normalized[behind] ** 2) == pytest.approx(1.0, abs=0.25)
    assert np.mean(doubted.normalized[behind + 1] ** 2) == pytest.approx(1.0, abs=0.25)
    taken_as_held = Filter(cstr(), SENSORS).run(FilterRecord(time_min[there], inputs, measured[there]))
    assert np.mean(taken_as_held.normalized[behind] ** 2) > 2.0


def test_what_a_noise_search_learns_does_not_take_holes_for_noise() -> None:
    time_min, qc, measured, there = with_holes(seed=4)
    inputs = qc[there][:, None]
    uncertainty = InputUncertainty.for_missing_rows(time_min[there], inputs, missing_of(time_min[there], qc[there]))
    records = (FilterRecord(time_min[there], inputs, measured[there], uncertainty=item) for item in (uncertainty, None))
    with_doubt, without = (fit_noise(cstr(), record, (1e-4, 0.01)).levels for record in records)
    assert with_doubt.process_sd[1] < 0.02
    assert without.process_sd[1] > 0.05


def test_a_sticking_valve_keeps_its_place_behind_a_hole() -> None:
    """It follows moves of more than 6 l/min alone, whenever they were."""
    fault = parse_fault("valve_stiction:constant:6.0")
    time_min, qc, measured = record_of(3000, seed=5, faults=(str(fault),))
    there = np.ones(3000, dtype=bool)
    there[2 + np.flatnonzero(np.diff(qc[1:]))[::3]] = False
    uncertainty = InputUncertainty.for_missing_rows(
        time_min[there], qc[there][:, None], missing_of(time_min[there], qc[there])
    )
    kalman = Filter(fault.extend(cstr()), NoiseLevels(SENSORS.measurement_sd, (0.0,) * 3))
    found = kalman.run(FilterRecord(time_min[there], qc[there], measured[there], uncertainty=uncertainty))
    stands = np.empty(3000)
    stands[0] = qc[0]
    for row in range(1, 3000):
        stands[row] = qc[row] if abs(qc[row] - stands[row - 1]) > 6.0 else stands[row - 1]
    np.testing.assert_allclose(found.x[20:, 2], stands[there][20:], atol=0.5)


def test_with_inserted_rows_a_filter_gives_the_output_it_gives_row_by_row() -> None:
    time_min, qc, measured, there = with_holes(seed=6)
    inputs, missing = qc[there][:, None], missing_of(time_min[there], qc[there])
    uncertainty = InputUncertainty.for_missing_rows(time_min[there], inputs, missing)
    kalman = Filter(cstr(), NoiseLevels(SENSORS.measurement_sd, (1e-4, 0.05)))
    rows = insert_rows(time_min[there], inputs, measured[there], uncertainty)
    assert rows.original_index.size == np.count_nonzero(there) < rows.time_min.size
    found = rows.at_original_rows(
        kalman.run(FilterRecord(rows.time_min, rows.inputs, rows.measured, uncertainty=rows.uncertainty))
    )
    expected = kalman.run(FilterRecord(time_min[there], inputs, measured[there], uncertainty=uncertainty))
    for name in FilterResult._fields:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-6, atol=1e-9, err_msg=name)


def test_a_record_without_holes_stays_as_it_is() -> None:
    time_min = 0.1 * np.arange(10.0)
    rows = insert_rows(time_min, np.zeros((10, 1)), np.zeros((10, 2)))
    assert rows.time_min is time_min


def filling() -> ProcessModel:
    """A tank that fills as fast as its valve lets it, and what its level fills; built from the reactor's parts."""
    model = cstr()
    level = replace(model.states[1], lower=-100.0, upper=100.0, scale=1.0)
    output = replace(model.outputs[1], expression=level.symbol)
    other = replace(model.states[0], lower=-100.0, upper=100.0, scale=1.0)
    rhs = model.inputs[0].symbol + ca.SX(0), level.symbol + ca.SX(0)
    return replace(model, states=(level, other), rhs=rhs, outputs=(output,), at_rest={}, resets={})


def with_holes(seed: int) -> tuple[Array, Array, Array, Array]:
    """A run of the reactor with rows missing, most where qc moves; which rows are there."""
    random = np.random.default_rng(seed)
    rows = 6000
    time_min, qc, measured = record_of(rows, seed=seed)
    there = np.ones(rows, dtype=bool)
    moves = np.flatnonzero(np.diff(qc)) + 1
    there[moves[random.random(moves.size) < 0.7]] = False
    there[random.random(rows) < 0.05] = False
    there[0] = True
    return time_min, qc, measured, there


def missing_of(time_min: Array, qc: Array) -> NDArray[np.intp]:
    missing = np.round(np.diff(time_min) / 0.1).astype(np.intp) - 1
    return np.append(0, np.where(np.diff(qc) != 0.0, missing, 0))
