"""Regressors from a record and from a stream."""

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.regressor import RegressorBuffer, consecutive_rows, rows_of
from reactorwatch.identification.structure import REPORT_ROWS, RowChoice, Structure
from reactorwatch.stored_state import copy_of

U = np.arange(10.0, 20.0)
Y = np.arange(0.0, 10.0)


def test_a_row_holds_past_outputs_then_past_inputs_then_one() -> None:
    """For na = 2, nb = 1, delay 3: y[k-1], y[k-2], u[k-3], 1."""
    rows = rows_of(Structure(2, 1, delay=3), U, Y)
    np.testing.assert_array_equal(rows.position, np.arange(3, 10))
    np.testing.assert_array_equal(rows.regressors[0], [2.0, 1.0, 10.0, 1.0])
    np.testing.assert_array_equal(rows.outputs[0], [3.0])


def test_several_signals_stand_side_by_side_at_each_lag() -> None:
    structure = Structure(1, 2, inputs=2, offset=False)
    rows = rows_of(structure, np.column_stack([U, -U]), Y)
    np.testing.assert_array_equal(rows.regressors[0], [1.0, 11.0, -11.0, 10.0, -10.0])


def test_missing_values_and_gaps_cost_the_rows_that_reach_over_them() -> None:
    """A missing output at 4 with lag 1, and a gap before 8, leave rows 1 2 3 6 7 9."""
    outputs = Y.copy()
    outputs[4] = np.nan
    time = np.arange(10.0)
    time[8:] += 0.5
    np.testing.assert_array_equal(rows_of(Structure.of_order(1), U, outputs, time).position, [1, 2, 3, 6, 7, 9])
    np.testing.assert_array_equal(consecutive_rows(outputs[:, None], time), [1, 2, 3, 4, 0, 1, 2, 3, 1, 2])


def test_the_report_row_choice_keeps_the_lags_of_the_fast_clock() -> None:
    u, y = np.arange(1000.0, 1120.0), np.arange(120.0)
    rows = rows_of(Structure.of_order(1), u, y, choice=REPORT_ROWS)
    np.testing.assert_array_equal(rows.position + 1, [100, 106, 112, 118])
    np.testing.assert_array_equal(rows.regressors[:, 0], rows.outputs[:, 0] - 1.0)
    buffer = RegressorBuffer(Structure.of_order(1), REPORT_ROWS)
    recursive = [buffer.update(k, [u[k]], [y[k]]) for k in range(120)]
    assert [k for k, row in enumerate(recursive) if row is not None] == rows.position.tolist()


def test_records_that_do_not_fit_are_refused() -> None:
    structure = Structure.of_order(1)
    with pytest.raises(InputError, match="equally many rows, got 10 and 9"):
        rows_of(structure, U, Y[:9])
    with pytest.raises(InputError, match=r"time must increase, got 1\.0 after 1\.0 in row 3"):
        rows_of(structure, U[:3], Y[:3], [0.0, 1.0, 1.0])
    with pytest.raises(InputError, match=r"time must have the shape \(10,\), got \(3,\)"):
        rows_of(structure, U, Y, [0.0, 1.0, 2.0])


def test_the_upcoming_regressor_is_the_one_that_the_next_row_gets() -> None:
    buffer = RegressorBuffer(Structure(2, 2, delay=2))
    for k in range(6):
        upcoming = buffer.upcoming
        regressor = buffer.update(k, [U[k]], [Y[k]])
        assert (upcoming is None) == (regressor is None) == (k < 3)
        if upcoming is not None and regressor is not None:
            np.testing.assert_array_equal(upcoming, regressor)


def test_a_row_that_cannot_be_is_refused_and_changes_nothing() -> None:
    buffer = RegressorBuffer(Structure.of_order(1))
    buffer.update(100, [1.0], [2.0])
    before = copy_of(buffer)
    with pytest.raises(ValueError, match="time_ns must increase, got 100 after 100"):
        buffer.update(100, [1.0], [2.0])
    with pytest.raises(ValueError, match="a row must have 1 inputs and 1 outputs"):
        buffer.update(110, [1.0, 2.0], [2.0])
    assert buffer == before


def test_a_stored_buffer_resumes_where_it_was() -> None:
    structure = Structure(3, 2, delay=2, inputs=2)
    buffer = RegressorBuffer(structure, RowChoice(1, 2))
    rng = np.random.default_rng(2)
    for k in range(12):
        resumed = copy_of(buffer)
        u, y = rng.standard_normal(2), rng.standard_normal(1)
        expected, got = buffer.update(k, u, y), resumed.update(k, u, y)
        np.testing.assert_array_equal(np.array(expected, dtype=float), np.array(got, dtype=float))
        assert resumed == buffer
    with pytest.raises(ValueError, match="there must be at most 3 equal rows"):
        RegressorBuffer(structure, outputs=[1.0] * 4, inputs=[1.0] * 8)
