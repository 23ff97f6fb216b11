"""A training that was itself disturbed is trimmed, or refused.

A model that errs after moves of the inputs does not keep its promise, and this is reported.
"""

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.harness.plants import TRAINING_MIN, sound_record, without_equations
from monitor_node.core import Monitor
from monitor_node.learn.training_rows import AfterMoves, after_largest_moves, compare_after_moves, screen_baseline
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Promise
from reactorwatch.records.record import MINUTE_NS

from ..samples import feed_row


def noise(seed: int, phi: float = 0.0, rows: int = 1000) -> np.ndarray:
    white = np.random.default_rng(seed).normal(size=rows + 300)
    return np.asarray(lfilter([1.0], [1.0, -phi], white))[300:]


@pytest.mark.parametrize(("phi", "most"), [(0.0, 2), (0.5, 4), (0.9, 10)])
def test_an_undisturbed_training_is_hardly_ever_trimmed(phi: float, most: int) -> None:
    assert sum(bool(screen_baseline(noise(seed, phi)).disturbed_intervals) for seed in range(200)) <= most


@pytest.mark.parametrize("start", [0, 320, 800])
def test_a_shifted_stretch_is_left_out_whole_and_little_else(start: int) -> None:
    z = noise(1)
    z[start : start + 200] += 3.0
    found = screen_baseline(z)
    assert not found.refused
    assert not found.usable[start : start + 200].any()
    assert np.count_nonzero(~found.usable) <= 200 + 2 * 40 + found.outliers
    assert found.shifts[0] == pytest.approx(3.0, abs=0.5)


def test_a_stretch_that_is_only_wilder_is_left_out() -> None:
    z = noise(2)
    z[400:560] *= 4.0
    assert np.mean(~screen_baseline(z).usable[400:560]) > 0.9


def test_a_training_disturbed_by_two_fifths_is_refused() -> None:
    z = noise(3)
    z[600:] += 2.5
    assert screen_baseline(z).refused


def test_single_outliers_are_left_out_and_their_block_is_not() -> None:
    z = noise(4)
    z[[50, 333, 700]] += (15.0, -20.0, 30.0)
    found = screen_baseline(z)
    assert (found.outliers, found.disturbed_intervals) == (3, [])
    assert np.flatnonzero(~found.usable).tolist() == [50, 333, 700]


def test_what_is_not_known_is_not_usable_and_disturbs_nothing() -> None:
    z = noise(5)
    z[::7] = np.nan
    found = screen_baseline(z)
    assert found.usable.tolist() == np.isfinite(z).tolist()
    assert not screen_baseline(np.full(10, np.nan)).usable.any()


def test_a_constant_residual_is_usable() -> None:
    assert screen_baseline(np.full(500, 2.0)).usable.all()


def promise_after(time_min: Array, rows: Array) -> Promise:
    """Promise of the ARX models after a training on rows of qc, C and T."""
    monitor = Monitor(without_equations("arx"), 0, points=False)
    for number, (minute, row) in enumerate(zip(time_min.tolist(), rows.tolist(), strict=True)):
        feed_row(monitor, number, round(minute * MINUTE_NS), row)
    promise = monitor.promise
    assert promise is not None
    return promise


@pytest.mark.parametrize("inputs", ["wide", "mid"])
def test_a_linear_model_of_the_curved_reactor_is_reported_to_err(inputs: str) -> None:
    """Without noise its residuals are all errors of the model."""
    record = sound_record(inputs, "none", 11, TRAINING_MIN + 1.0)
    promise = promise_after(record.time_min, np.column_stack([record.columns[name] for name in ("qc", "C", "T")]))
    assert not promise.kept
    assert promise.can_keep_per_30_days > 1.5 * promise.expected
    assert "errs after moves of the inputs" in promise.text


@pytest.mark.parametrize("seed", range(3))
def test_a_linear_model_of_a_linear_plant_is_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = round(10 * TRAINING_MIN) + 10
    flows, states = np.repeat(rng.uniform(90.0, 111.0, count // 10), 10), np.zeros((count, 2))
    for k in range(1, count):
        states[k] = np.array([[0.9, 0.05], [-0.1, 0.8]]) @ states[k - 1] + np.array([0.01, -0.2]) * (
            flows[k - 1] - 100.0
        )
    outputs = states + rng.normal(size=states.shape) * [0.01, 0.3]
    assert promise_after(np.arange(count) / 10.0, np.column_stack([flows, outputs])).kept


def test_outliers_count_where_they_come_after_moves_and_not_elsewhere() -> None:
    rng = np.random.default_rng(2)
    u = np.repeat(rng.normal(size=(60, 1)), 20, axis=0)
    moved = np.flatnonzero(after_largest_moves(u))
    assert 0.05 < len(moved) / len(u) <= 0.1
    for rows, errs in ((moved[::3], True), (rng.permutation(len(u))[: len(moved) // 3], False)):
        e = rng.normal(size=(len(u), 1))
        e[rows] = np.inf
        assert (compare_after_moves(e, u) != AfterMoves()) == errs


def test_inputs_that_never_move_or_move_in_every_row_show_nothing() -> None:
    e = np.random.default_rng(3).normal(size=(500, 2))
    for u in (np.zeros((500, 1)), np.zeros((500, 0)), np.full((500, 1), np.nan), np.tile([[0.0], [1.0]], (250, 1))):
        assert compare_after_moves(e, u) == AfterMoves()
