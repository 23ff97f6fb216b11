"""Identification with several inputs, and with none, held to known systems and to regressors made by hand."""

import json
import math

import msgspec
import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.dataset import Dataset
from reactorwatch.identification.identify import MODELS, Identification, ModelForm, identify
from tests.unit.identification.systems import ARMAX, ARX, AUTOREGRESSION, BOX_JENKINS, OUTPUT_ERROR, System

ROWS = 1200


def data_of(system: System, seed: int = 1, rows: int = ROWS) -> Dataset:
    u, y = system.simulate(rows, seed)
    return Dataset.of(np.arange(float(rows)), u, y, output_name="th")


def parameters(found: Identification, of_sd: bool = False) -> list[float]:
    part = found.sd if of_sd else found
    assert isinstance(part.b, dict)
    return [*part.a, *part.b["u1"], *part.b["u2"], part.offset]


def test_arx_with_two_inputs_is_least_squares_on_the_regressor_made_by_hand() -> None:
    data = data_of(ARX)
    found = identify(data, ModelForm("arx", order=2))
    y, u, k = data.output[:600, 0], data.inputs[:600], np.arange(2, 600)
    columns = [y[k - 1], y[k - 2], u[k - 1, 0], u[k - 2, 0], u[k - 1, 1], u[k - 2, 1], np.ones(k.size)]
    np.testing.assert_allclose(parameters(found), np.linalg.lstsq(np.column_stack(columns), y[k])[0], rtol=1e-8)


@pytest.mark.parametrize(("model", "system"), [("arx", ARX), ("oe", OUTPUT_ERROR)])
def test_known_parameters_of_two_inputs_lie_within_their_standard_deviations(model: str, system: System) -> None:
    errors = []
    truth = np.array([*system.f, *np.transpose(system.b).ravel(), system.offset])
    for seed in range(8):
        found = identify(data_of(system, seed), ModelForm(model, order=2))
        errors.append((np.array(parameters(found)) - truth) / np.array(parameters(found, of_sd=True)))
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.4
    assert np.max(np.abs(errors)) < 4.5


def test_row_by_row_two_inputs_give_what_all_rows_give() -> None:
    data = data_of(ARX, rows=4000)
    batch, recursive = (identify(data, ModelForm("arx", order=2, recursive=flag)) for flag in (False, True))
    difference = np.abs(np.subtract(parameters(batch), parameters(recursive)))
    assert np.all(difference < np.array(parameters(batch, of_sd=True)) * 1e-6)


def test_without_inputs_it_is_an_autoregression() -> None:
    data = data_of(AUTOREGRESSION)
    found = identify(data, ModelForm("arx", order=2))
    y, k = data.output[:600, 0], np.arange(2, 600)
    truth = np.linalg.lstsq(np.column_stack([y[k - 1], y[k - 2], np.ones(k.size)]), y[k])[0]
    np.testing.assert_allclose([*found.a, found.offset], truth, rtol=1e-8)
    assert found.b == found.sd.b == ()
    recursive = identify(data, ModelForm("arx", order=2, recursive=True))
    np.testing.assert_allclose(recursive.a, found.a, rtol=1e-6)
    assert set(found.checks) == {"variation", "conditioning", "amplitude", "whiteness"}


def test_a_decay_without_inputs_is_an_output_error_model() -> None:
    """Cooling from 80 to 20, measured with noise: its time constant from the free run alone."""
    k = np.arange(400.0)
    y = 20.0 + 60.0 * 0.97**k + 0.3 * np.random.default_rng(1).standard_normal(400)
    found = identify(Dataset.of(k, np.empty((400, 0)), y), ModelForm("oe", order=1))
    assert abs(found.a[0] - 0.97) < 4.0 * found.sd.a[0]
    assert found.offset / (1.0 - found.a[0]) == pytest.approx(20.0, abs=0.5)


@pytest.mark.parametrize(
    ("model", "system", "noise"),
    [("arx", ARX, ()), ("oe", OUTPUT_ERROR, ()), ("armax", ARMAX, ("c",)), ("bj", BOX_JENKINS, ("c", "d", "f"))],
)
def test_the_json_has_the_promised_names(model: str, system: System, noise: tuple[str, ...]) -> None:
    told = json.loads(msgspec.json.encode(identify(data_of(system), ModelForm(model, order=2))))
    assert set(told) == {
        *("model", "order", "delay", "output", "rows", "recursive"),
        *("a", "b", "offset", "sd", "fit_percent", "whiteness_minus_log10_p", "checks"),
        *noise,
    }
    assert set(told["b"]) == set(told["sd"]["b"]) == {"u1", "u2"}
    assert set(told["sd"]) == {"a", "b", "offset", *noise}
    assert all(len(told[name]) == len(told["sd"][name]) == 2 for name in noise)
    assert len(told["a"]) == (0 if model == "bj" else 2)
    assert told["checks"]["whiteness"] == "ok"


def test_a_record_for_validation_is_run_freely_and_all_rows_are_fitted() -> None:
    """The free run of the other record, written out here from the parameters."""
    fitted, other = data_of(ARX, 1), data_of(ARX, 2, rows=300)
    found = identify(fitted, ModelForm("arx", order=2), other)
    assert found.rows == ROWS
    a1, a2, b11, b12, b21, b22, offset = parameters(found)
    y, u = other.output[:, 0], other.inputs
    run = list(y[:2])
    for k in range(2, 300):
        forced = b11 * u[k - 1, 0] + b12 * u[k - 2, 0] + b21 * u[k - 1, 1] + b22 * u[k - 2, 1] + offset
        run.append(a1 * run[k - 1] + a2 * run[k - 2] + forced)
    assert found.rmse is not msgspec.UNSET
    assert found.rmse.free_run == pytest.approx(np.sqrt(np.mean((y[2:] - run[2:]) ** 2)), rel=1e-9)
    assert found.rmse.one_step == pytest.approx(0.5, rel=0.15)


def test_rows_that_settle_set_the_state_and_are_left_out() -> None:
    """A slow plant measured with much noise: n noisy rows start it badly, fifty rows do not."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.standard_normal(100), 12)
    clean = np.zeros(1200)
    for k in range(1, 1200):
        clean[k] = 0.99 * clean[k - 1] + 0.1 * u[k - 1]
    data = Dataset.of(np.arange(1200.0), u, clean + rng.standard_normal(1200))
    other = Dataset.of(np.arange(200.0), u[600:800], clean[600:800] + np.where(np.arange(200) < 1, 3.0, 0.0))
    raw, settled = (identify(data, ModelForm("oe", order=1), other, settle) for settle in (0, 50))
    assert raw.rmse is not msgspec.UNSET
    assert settled.rmse is not msgspec.UNSET
    assert settled.rmse.free_run < 0.5 * raw.rmse.free_run


def test_settling_rows_follow_gaps_and_missing_values() -> None:
    data = data_of(ARMAX)
    other = data_of(ARMAX, 2, rows=200)
    other.output[3:6] = math.nan
    other.inputs[30] = math.nan
    for settle in (5, 20, 60):
        found = identify(data, ModelForm("armax", order=2), other, settle)
        assert found.fit.free_run > 60.0


U, Y = ARX.simulate(200, 1)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(
    ("u", "y", "text"),
    [
        (U, np.full(200, 4.5), "output th is constant, 4.5 in all rows to fit"),
        (U * [1.0, 0.0] + [0.0, 7.0], Y, "input u2 never moves, 7 in all rows to fit"),
        (U[:20], Y[:20], r"order 3 with delay 1 needs more than \d+ rows to fit, .* got 10"),
        (U * math.nan, Y, "u1 has no measured value in the rows to fit"),
    ],
)
def test_a_record_that_determines_nothing_is_refused_before_any_fit(
    model: str, u: np.ndarray, y: np.ndarray, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("reactorwatch.identification.identify.MODELS", dict.fromkeys(MODELS))
    data = Dataset.of(np.arange(float(len(y))), u, y, output_name="th", missing="leave out")
    with pytest.raises(InputError, match=text) as caught:
        identify(data, ModelForm(model))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("model", MODELS)
def test_inputs_that_move_in_proportion_are_refused_as_such(model: str) -> None:
    u = np.column_stack([U[:, 0], 3.0 * U[:, 0] + 1.0])
    with pytest.raises(InputError, match="inputs that move in proportion, excite none"):
        identify(Dataset.of(np.arange(200.0), u, Y), ModelForm(model, order=1))


def test_rows_that_settle_must_leave_rows_to_judge() -> None:
    data = data_of(ARX, rows=200)
    with pytest.raises(InputError, match="the held-out part needs more rows than the 100 that set the state, got 100"):
        identify(data, settle=100)
    with pytest.raises(InputError, match="settle must be at least 0 rows, got -1"):
        identify(data, settle=-1)


@pytest.mark.parametrize("model", ["oe", "armax", "bj", "narx", "noe"])
def test_only_arx_is_learned_row_by_row(model: str) -> None:
    with pytest.raises(InputError, match=f"only arx can be recursive, got {model}: leave --recursive out"):
        ModelForm(model, recursive=True)


def test_forgetting_without_a_recursive_model_is_refused() -> None:
    with pytest.raises(InputError, match=r"forgetting is of a recursive model, got 0\.9: add --recursive"):
        ModelForm(forgetting=0.9)
