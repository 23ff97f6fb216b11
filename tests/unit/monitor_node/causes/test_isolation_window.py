"""Rows that enter the isolation: those since the last gap, without unconfirmed ones."""

from math import nan

import numpy as np
import pytest

from monitor_node.causes.isolation import causes_of
from monitor_node.causes.scan import GlrScan
from monitor_node.causes.window import BURN_IN_ROWS, Row, Window, window_of
from reactorwatch.kalman.batch import GATE
from reactorwatch.kalman.ekf import Filter
from reactorwatch.process.library.cstr import cstr
from tests.unit.monitor_node.faulty import ONSET_MIN, SENSORS, rows_of


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return rows_of(seed=1, after_min=0.0, begin_min=40.0)


def settled(rows: list[Row]) -> Window:
    window = window_of(rows, Filter(cstr(), SENSORS))
    assert window is not None
    return window


def shifted(rows: list[Row], places: list[int], column: int, size: float) -> list[Row]:
    changed = list(rows)
    for place in places:
        time_min, flow, values = rows[place]
        changed[place] = (time_min, flow, [v + size * (index == column) for index, v in enumerate(values)])
    return changed


def missing(window: Window) -> list[tuple[int, int]]:
    return [(int(row), int(column)) for row, column in np.argwhere(np.isnan(window.measured))]


def test_the_smallest_window_in_which_an_onset_can_be_sought_can_be_scanned(rows: list[Row]) -> None:
    kalman = Filter(cstr(), SENSORS)
    windows = [window_of(rows[:count], kalman) for count in range(BURN_IN_ROWS - 1, BURN_IN_ROWS + 4)]
    assert [window is None for window in windows] == [True, True, True, False, False]
    scan = GlrScan(cstr(), SENSORS, causes_of(cstr()))
    assert all(scan.scan(window)[1].onset_min.size for window in windows if window is not None)


def test_without_outliers_everything_counts(rows: list[Row]) -> None:
    window = settled(rows)
    assert missing(window) == []
    np.testing.assert_array_equal(window.measured, [row[2] for row in rows])
    np.testing.assert_array_equal(window.inputs, [row[1] for row in rows])
    assert window.earliest_min == rows[BURN_IN_ROWS][0]
    assert np.all(window.used[1:])


@pytest.mark.parametrize(("column", "size"), [(0, 0.05), (1, -8.0)])
@pytest.mark.parametrize("places", [[100], [100, 101]])
def test_one_or_two_values_that_stand_out_do_not_count(
    rows: list[Row], column: int, size: float, places: list[int]
) -> None:
    assert missing(settled(shifted(rows, places, column, size))) == [(place, column) for place in places]


def test_the_same_in_the_middle_of_a_fault() -> None:
    rows = rows_of("coolant_flow:step:-0.05", seed=2, after_min=5.0, begin_min=40.0)
    place = next(place for place, row in enumerate(rows) if row[0] > ONSET_MIN + 2.0)
    assert missing(settled(shifted(rows, [place], 1, 8.0))) == [(place, 1)]


def test_a_step_counts_in_full(rows: list[Row]) -> None:
    stepped = shifted(rows, list(range(100, len(rows))), 1, 5.0)
    window = settled(stepped)
    assert missing(window) == []
    assert not window.used[100, 1]  # nothing confirmed it yet
    assert window.used[101, 1]


def test_the_newest_value_counts_only_if_the_one_before_confirms_it(rows: list[Row]) -> None:
    last = len(rows) - 1
    assert missing(settled(shifted(rows, [last], 1, 8.0))) == [(last, 1)]
    assert missing(settled(shifted(rows, [last - 1, last], 1, 8.0))) == []


def test_only_rows_since_the_last_gap_count(rows: list[Row]) -> None:
    assert settled(rows[:50] + rows[60:]).time_min[0] == rows[60][0]
    assert settled(rows[:50] + rows[53:]).time_min[0] == rows[0][0]
    assert settled(rows[50:] + rows[40:]).time_min[0] == rows[40][0]


def test_where_the_input_is_missing_it_is_as_it_was(rows: list[Row]) -> None:
    holes: list[Row] = [(t, (nan,) if place % 3 else flow, y) for place, (t, flow, y) in enumerate(rows[1:])]
    window = settled(holes)
    assert window.inputs[:6, 0].tolist() == [rows[1][1][0]] * 3 + [rows[4][1][0]] * 3


def test_nothing_sets_in_while_the_filter_settles(rows: list[Row]) -> None:
    assert settled(rows).onset_span_min == pytest.approx(rows[-1][0] - rows[BURN_IN_ROWS - 1][0])
    assert window_of(rows[:BURN_IN_ROWS], Filter(cstr(), SENSORS)) is None
    assert window_of([], Filter(cstr(), SENSORS)) is None


@pytest.mark.parametrize("fault", ["", "coolant_flow:step:-0.3", "temperature_bias:step:30"])
def test_rows_filtered_in_chunks_are_those_of_a_filter_that_takes_row_by_row(fault: str) -> None:
    """A value beyond the gate corrects the filter only if the one before was beyond it, too; some values are wild."""
    rows = rows_of(*([fault] if fault else []), seed=3, after_min=5.0, begin_min=45.0)
    rows = shifted(rows, [40, 41, 60, 90, 91, 92, 93], 1, 60.0)
    rows[100] = (rows[100][0], rows[100][1], (nan, nan))
    window, kalman = settled(rows), Filter(cstr(), SENSORS)
    accept = [False, False]
    for index, (time_min, flow, values) in enumerate(rows):
        result = kalman.update(time_min, flow, values, gate=GATE, accept=accept)
        accept = [abs(size) > GATE * sd for size, sd in zip(result.residual, result.sd, strict=True)]
        assert tuple(window.x[index].tolist()) == kalman.state.x
        assert tuple(window.covariance[index].ravel().tolist()) == kalman.state.P
