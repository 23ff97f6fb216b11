"""Regressors from a record."""

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.regressor import consecutive_rows, rows_of
from reactorwatch.identification.structure import REPORT_ROWS, Structure

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


def test_records_that_do_not_fit_are_refused() -> None:
    structure = Structure.of_order(1)
    with pytest.raises(InputError, match="equally many rows, got 10 and 9"):
        rows_of(structure, U, Y[:9])
    with pytest.raises(InputError, match=r"time must increase, got 1\.0 after 1\.0 in row 3"):
        rows_of(structure, U[:3], Y[:3], [0.0, 1.0, 1.0])
    with pytest.raises(InputError, match=r"time must have the shape \(10,\), got \(3,\)"):
        rows_of(structure, U, Y, [0.0, 1.0, 2.0])
