"""Orders, names, row choices, and scaling with its undoing."""

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.structure import RowChoice, Scaling, Structure, as_columns


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


def test_names_of_several_signals_have_their_number() -> None:
    structure = Structure(1, 1, inputs=2, offset=False)
    assert structure.parameter_names() == ("a1", "b1_1", "b1_2")


def test_a_row_choice_that_cannot_be_is_named() -> None:
    with pytest.raises(InputError, match="every must be at least 1, got 0"):
        RowChoice(every=0)
    with pytest.raises(InputError, match="skip must be at least 0, got -1"):
        RowChoice(skip=-1)


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
    np.testing.assert_allclose(scaling.scale_parameters(structure, own), theta, rtol=1e-9)


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
