"""Structures, scaling with its undoing, and regressors from a record."""

import msgspec
import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.data import consecutive_rows, rows_of
from reactorwatch.identification.structure import Scaling, Structure, as_columns

U = np.arange(10.0, 20.0)
Y = np.arange(0.0, 10.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 1, 1, 1), r"order \(lags of the output\) must be at least 1, got 0"),
        ((1, 0, 1, 1), r"order \(lags of the input\) must be at least 1, got 0"),
        ((1, 1, -2, 1), r"delay \(samples\) must be at least 1, got -2"),
        ((1, 1, 1, -1), "number of inputs must be at least 0, got -1"),
    ],
)
def test_a_structure_that_cannot_be_is_named(arguments: tuple[int, int, int, int], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Structure(*arguments)
    with pytest.raises(InputError, match="order must be at least 1, got 0"):
        Structure.of_order(0)
    with pytest.raises(InputError, match="a model has one output, got 2"):
        Structure(1, 1, outputs=2)


def test_arx_33_has_seven_parameters_and_reaches_back_three_rows() -> None:
    structure = Structure.of_order(3)
    assert structure.parameters == 7
    assert structure.history == 3
    assert structure.parameter_names() == ("a1", "a2", "a3", "b1", "b2", "b3", "c")
    assert Structure(1, 2, delay=4).history == 5
    assert Structure(1, 1, inputs=2, offset=False).parameter_names() == ("a1", "b1_1", "b1_2")


def test_undoing_the_scaling_gives_the_same_predictions() -> None:
    """Two inputs, random parameters: scaled model on scaled signals = undone model on the signals."""
    rng = np.random.default_rng(1)
    structure = Structure(2, 1, inputs=2)
    u, y = rng.normal([100.0, 3.0], [5.0, 0.1], (50, 2)), rng.normal(440.0, 3.0, (50, 1))
    scaling, k = Scaling.of(u, y), 10
    theta = rng.standard_normal(structure.parameters)
    matrix, shift = scaling.unscaling(structure)
    own = matrix @ theta + shift
    scaled_u, scaled_y = scaling.inputs(u), scaling.outputs(y)
    scaled = np.concatenate([scaled_y[k - 1], scaled_y[k - 2], scaled_u[k - 1], [1.0]]) @ theta
    plain = np.concatenate([y[k - 1], y[k - 2], u[k - 1], [1.0]]) @ own
    assert plain == pytest.approx(scaled * scaling.output_spreads[0] + scaling.output_centres[0], rel=1e-12)


def test_a_model_without_offset_is_scaled_but_not_centred() -> None:
    structure = Structure(1, 1, offset=False)
    scaling = Scaling.of([1.0, 3.0], [10.0, 20.0], centred=False)
    assert scaling.input_centres == scaling.output_centres == (0.0,)
    np.testing.assert_allclose(scaling.unscaling(structure)[0], np.diag([1.0, 5.0]))
    with pytest.raises(InputError, match="use centred=False"):
        Scaling.of([1.0, 3.0], [10.0, 20.0]).unscaling(structure)


def test_a_constant_signal_keeps_its_size() -> None:
    assert Scaling.of([7.0, 7.0], [1.0, 2.0]).input_spreads == (1.0,)
    with pytest.raises(InputError, match="input 1 has no measured value"):
        Scaling.of([np.nan, np.nan], [1.0, 2.0])
    with pytest.raises(InputError, match="spread of a signal must be finite and above 0, got 0"):
        Scaling((0.0,), (0.0,), (0.0,), (1.0,))
    with pytest.raises(InputError, match="centre of a signal must be finite"):
        Scaling((np.inf,), (1.0,), (0.0,), (1.0,))


def test_signals_have_one_row_a_sample() -> None:
    assert as_columns([1.0, 2.0], "inputs").shape == (2, 1)
    with pytest.raises(InputError, match=r"inputs must have the shape \(rows, 2\), got \(3, 1\)"):
        as_columns([1.0, 2.0, 3.0], "inputs", 2)


def test_a_row_holds_past_outputs_then_past_inputs_then_one() -> None:
    """For na = 2, nb = 1, delay 3: y[k-1], y[k-2], u[k-3], 1."""
    rows = rows_of(Structure(2, 1, delay=3), U, Y)
    np.testing.assert_array_equal(rows.position, np.arange(3, 10))
    np.testing.assert_array_equal(rows.regressors[0], [2.0, 1.0, 10.0, 1.0])
    np.testing.assert_array_equal(rows.outputs[0], [3.0])


@pytest.mark.parametrize(
    ("delay", "first", "regressor"),
    [
        (1, 2, [1.0, 11.0, -11.0, 10.0, -10.0]),
        ((1, 3), 4, [3.0, 13.0, -11.0, 12.0, -10.0]),
        ((4, 1), 5, [4.0, 11.0, -14.0, 10.0, -13.0]),
    ],
)
def test_several_inputs_stand_side_by_side_at_each_lag_each_with_its_delay(
    delay: int | tuple[int, int], first: int, regressor: list[float]
) -> None:
    structure = Structure(1, 2, delay, inputs=2, offset=False)
    rows = rows_of(structure, np.column_stack([U, -U]), Y)
    assert rows.position[0] == first
    np.testing.assert_array_equal(rows.regressors[0], regressor)


def test_equal_delays_of_the_inputs_are_one_delay() -> None:
    assert Structure(2, 2, (3, 3), 2) == Structure(2, 2, 3, 2)
    assert Structure(2, 2, (1, 3), 2).delays == (1, 3)
    assert msgspec.structs.replace(Structure(2, 2, (1, 3), 2), inputs=0).history == 2
    with pytest.raises(InputError, match=r"one delay for each of 2 inputs, got \(1, 2, 3\)"):
        Structure(2, 2, (1, 2, 3), 2)
    with pytest.raises(InputError, match=r"delay .* at least 1, got 0"):
        Structure(2, 2, (4, 0), 2)


def test_missing_values_and_gaps_cost_the_rows_that_reach_over_them() -> None:
    """A missing output at 4 with lag 1, and a gap before 8, leave rows 1 2 3 6 7 9."""
    outputs = Y.copy()
    outputs[4] = np.nan
    time = np.arange(10.0)
    time[8:] += 0.5
    np.testing.assert_array_equal(rows_of(Structure.of_order(1), U, outputs, time).position, [1, 2, 3, 6, 7, 9])
    np.testing.assert_array_equal(consecutive_rows(outputs[:, None], time), [1, 2, 3, 4, 0, 1, 2, 3, 1, 2])


def test_records_that_do_not_fit_are_refused() -> None:
    structure = Structure.of_order(1)
    with pytest.raises(InputError, match="equally many rows, got 10 and 9"):
        rows_of(structure, U, Y[:9])
    with pytest.raises(InputError, match=r"time must increase, got 1\.0 after 1\.0 in row 3"):
        rows_of(structure, U[:3], Y[:3], [0.0, 1.0, 1.0])
    with pytest.raises(InputError, match=r"time must have the shape \(10,\), got \(3,\)"):
        rows_of(structure, U, Y, [0.0, 1.0, 2.0])
