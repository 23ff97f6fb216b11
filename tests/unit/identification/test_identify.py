"""The result of `reactorwatch identify --json`, with any number of inputs, and on records of real plants."""

import json
import math
import os
from pathlib import Path

import msgspec
import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.data import Dataset
from reactorwatch.identification.identify import MODELS, Identification, ModelForm
from reactorwatch.identification.identify import identify as identify_data
from reactorwatch.identification.linear_model import fit_percent
from tests.unit.identification.truth import (
    ARMAX,
    ARX,
    AUTOREGRESSION,
    BOX_JENKINS,
    OUTPUT_ERROR,
    Daisy,
    NoisyPlant,
    System,
    identify,
)

ROWS = 1200
ROOT = Path(__file__).parents[3]


def parameters(found: Identification, of_sd: bool = False) -> list[float]:
    part = found.sd if of_sd else found
    inputs = part.b.values() if isinstance(part.b, dict) else [part.b]
    return [*part.a, *(value for values in inputs for value in values), part.offset]


def test_it_prints_the_parameters_and_fits_of_the_daisy_record(daisy: Daisy) -> None:
    """Every number against LAPACK and the recursion written out, from the unscaled columns."""
    reported = identify(daisy.time, daisy.qc, daisy.T, order=3, name="T")
    half, u, y = 3750, daisy.qc, daisy.T
    k = np.arange(3, half)
    columns = [y[k - 1], y[k - 2], y[k - 3], u[k - 1], u[k - 2], u[k - 3], np.ones(k.size)]
    theta = np.linalg.lstsq(np.column_stack(columns), y[k])[0]
    np.testing.assert_allclose([*reported.a, *reported.b, reported.offset], theta, rtol=1e-6)
    run, held_out, driven = list(y[half : half + 3]), y[half:], u[half:]
    for j in range(3, half):
        run.append(theta @ [run[j - 1], run[j - 2], run[j - 3], driven[j - 1], driven[j - 2], driven[j - 3], 1.0])
    assert reported.fit_percent.free_run == pytest.approx(fit_percent(held_out[3:], run[3:]), abs=1e-3)
    assert reported.fit_percent.one_step > 99.5
    assert (reported.model, reported.order, reported.delay, reported.output, reported.rows) == ("arx", 3, 1, "T", half)
    assert reported.checks["excitation"] == reported.checks["sampling"] == "ok"
    # The reactor is not linear, the record has no noise, and so the residuals cannot be white.
    assert reported.whiteness_minus_log10_p > 6.0
    assert "leaves something out" in reported.checks["whiteness"]


def test_row_by_row_it_finds_what_it_finds_at_once(noisy_plant: NoisyPlant) -> None:
    """To 1e-9 of a standard deviation."""
    time = np.arange(4000.0)
    batch = identify(time, noisy_plant.inputs, noisy_plant.measured, order=2)
    recursive = identify(time, noisy_plant.inputs, noisy_plant.measured, order=2, recursive=True)
    difference = np.abs(np.subtract(parameters(recursive), parameters(batch)))
    assert np.all(difference < np.array(parameters(batch, of_sd=True)) * 1e-9)
    assert recursive.recursive
    assert not batch.recursive


def test_a_true_model_leaves_white_residuals_and_a_biased_one_does_not(noisy_plant: NoisyPlant) -> None:
    time = np.arange(4000.0)
    oe = identify(time, noisy_plant.inputs, noisy_plant.measured, model="oe", order=2)
    arx = identify(time, noisy_plant.inputs, noisy_plant.measured, model="arx", order=2)
    assert oe.checks["whiteness"] == oe.checks["independence"] == "ok"
    assert arx.checks["whiteness"] != "ok"
    assert oe.fit_percent.free_run > arx.fit_percent.free_run


def test_gaps_and_missing_rows_are_left_out_where_that_is_asked_for(noisy_plant: NoisyPlant) -> None:
    u, y, time = noisy_plant.inputs.copy(), noisy_plant.clean.copy(), np.arange(4000.0)
    y[100:103], u[500] = np.nan, np.nan
    time[1000:] += 40.0
    for recursive in (False, True):
        reported = identify(time, u, y, order=2, missing="leave out", recursive=recursive)
        np.testing.assert_allclose(parameters(reported), noisy_plant.parameters, atol=1e-8)
    batch = identify(time, u, y, model="oe", order=2, missing="leave out")
    np.testing.assert_allclose(parameters(batch), noisy_plant.parameters, atol=1e-3)


def test_a_record_that_determines_nothing_is_refused_with_the_cause(noisy_plant: NoisyPlant) -> None:
    time, u, y = np.arange(200.0), noisy_plant.inputs[:200], noisy_plant.measured[:200]

    def assert_refused(
        match: str, t: object = time, inputs: object = u, outputs: object = y, **options: object
    ) -> None:
        with pytest.raises(InputError, match=match) as caught:
            identify(t, inputs, outputs, **options)  # type: ignore[arg-type]
        assert "\n" not in str(caught.value)

    holed, infinite = u.copy(), y.copy()
    holed[3], infinite[7] = math.nan, math.inf
    assert_refused(r"unknown model 'fir' \(valid: arx, oe, armax, bj, narx, noe\)", model="fir")
    assert_refused("order must be at least 1, got 0", order=0)
    assert_refused(r"delay \(samples\) must be at least 1, got -1", delay=-1)
    assert_refused(
        "order 3 with delay 1 needs more than 10 rows to fit, the first half of .*, got 6", time[:12], u[:12], y[:12]
    )
    assert_refused("inputs must have a value in every row, got NaN in row 4", inputs=holed)
    assert_refused("outputs must be finite, got inf in row 8", outputs=infinite)
    assert_refused("output y is constant, 441 in all rows", outputs=np.full(200, 441.0))
    assert_refused(
        "input u never moves, 98 in all rows to fit: a constant input excites none",
        inputs=np.full(200, 98.0),
        outputs=np.cumsum(y),
    )
    assert_refused("equally many rows, got 199, 200 and 200", time[:199])
    assert_refused("time must increase", np.zeros(200))
    assert_refused(r"forgetting must be in \(0, 1\], got 2", recursive=True, forgetting=2.0)
    assert_refused(
        "parameters need as many complete rows", outputs=np.where(np.arange(200) % 3, y, math.nan), missing="leave out"
    )


def test_a_single_sinusoid_is_refused_by_name() -> None:
    """Without noise its regressors are singular: the cause is the input, and that is what is told."""
    time = np.arange(400.0)
    y = np.sin(0.3 * time - 0.5)
    with pytest.raises(InputError, match=r"as a single sinusoid does.*order 6 is needed"):
        identify(time, np.sin(0.3 * time), y, order=3)
    with pytest.raises(InputError, match=r"as a single sinusoid does.*order 6 is needed"):
        identify(time, np.sin(0.3 * time), y, order=3, recursive=True)


def data_of(system: System, seed: int = 1, rows: int = ROWS) -> Dataset:
    u, y = system.simulate(rows, seed)
    return Dataset.of(np.arange(float(rows)), u, y, output_name="th")


def test_arx_with_two_inputs_is_least_squares_on_the_regressor_made_by_hand() -> None:
    data = data_of(ARX)
    found = identify_data(data, ModelForm("arx", order=2))
    y, u, k = data.output[:600, 0], data.inputs[:600], np.arange(2, 600)
    columns = [y[k - 1], y[k - 2], u[k - 1, 0], u[k - 2, 0], u[k - 1, 1], u[k - 2, 1], np.ones(k.size)]
    np.testing.assert_allclose(parameters(found), np.linalg.lstsq(np.column_stack(columns), y[k])[0], rtol=1e-8)


def test_without_inputs_it_is_an_autoregression() -> None:
    data = data_of(AUTOREGRESSION)
    found = identify_data(data, ModelForm("arx", order=2))
    y, k = data.output[:600, 0], np.arange(2, 600)
    truth = np.linalg.lstsq(np.column_stack([y[k - 1], y[k - 2], np.ones(k.size)]), y[k])[0]
    np.testing.assert_allclose([*found.a, found.offset], truth, rtol=1e-8)
    assert found.b == found.sd.b == ()
    recursive = identify_data(data, ModelForm("arx", order=2, recursive=True))
    np.testing.assert_allclose(recursive.a, found.a, rtol=1e-6)
    assert set(found.checks) == {"variation", "conditioning", "amplitude", "whiteness", "stability"}


def test_a_decay_without_inputs_is_an_output_error_model() -> None:
    """Cooling from 80 to 20, measured with noise: its time constant from the free run alone."""
    k = np.arange(400.0)
    y = 20.0 + 60.0 * 0.97**k + 0.3 * np.random.default_rng(1).standard_normal(400)
    found = identify_data(Dataset.of(k, np.empty((400, 0)), y), ModelForm("oe", order=1))
    assert abs(found.a[0] - 0.97) < 4.0 * found.sd.a[0]
    assert found.offset / (1.0 - found.a[0]) == pytest.approx(20.0, abs=0.5)


@pytest.mark.parametrize(
    ("model", "system", "noise"),
    [("arx", ARX, ()), ("oe", OUTPUT_ERROR, ()), ("armax", ARMAX, ("c",)), ("bj", BOX_JENKINS, ("c", "d", "f"))],
)
def test_the_json_has_the_promised_names(model: str, system: System, noise: tuple[str, ...]) -> None:
    reported = json.loads(msgspec.json.encode(identify_data(data_of(system), ModelForm(model, order=2)).to_dict()))
    assert set(reported) == {
        *("model", "order", "delay", "output", "rows", "recursive"),
        *("a", "b", "offset", "sd", "fit_percent", "whiteness_minus_log10_p", "checks"),
        *noise,
    }
    assert set(reported["b"]) == set(reported["sd"]["b"]) == {"u1", "u2"}
    assert set(reported["sd"]) == {"a", "b", "offset", *noise}
    assert all(len(reported[name]) == len(reported["sd"][name]) == 2 for name in noise)
    assert len(reported["a"]) == (0 if model == "bj" else 2)
    assert reported["checks"]["whiteness"] == "ok"


def test_a_record_for_validation_is_run_freely_and_all_rows_are_fitted() -> None:
    """The free run of the other record, written out here from the parameters."""
    fitted, other = data_of(ARX, 1), data_of(ARX, 2, rows=300)
    found = identify_data(fitted, ModelForm("arx", order=2), other)
    assert found.rows == ROWS
    a1, a2, b11, b12, b21, b22, offset = parameters(found)
    y, u = other.output[:, 0], other.inputs
    run = list(y[:2])
    for k in range(2, 300):
        forced = b11 * u[k - 1, 0] + b12 * u[k - 2, 0] + b21 * u[k - 1, 1] + b22 * u[k - 2, 1] + offset
        run.append(a1 * run[k - 1] + a2 * run[k - 2] + forced)
    assert found.rmse is not None
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
    raw, settled = (identify_data(data, ModelForm("oe", order=1), other, settle) for settle in (0, 50))
    assert raw.rmse is not None
    assert settled.rmse is not None
    assert settled.rmse.free_run < 0.5 * raw.rmse.free_run


def test_settling_rows_follow_gaps_and_missing_values() -> None:
    data = data_of(ARMAX)
    other = data_of(ARMAX, 2, rows=200)
    other.output[3:6] = math.nan
    other.inputs[30] = math.nan
    for settle in (5, 20, 60):
        found = identify_data(data, ModelForm("armax", order=2), other, settle)
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
        identify_data(data, ModelForm(model))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("model", MODELS)
def test_inputs_that_move_in_proportion_are_refused_as_such(model: str) -> None:
    u = np.column_stack([U[:, 0], 3.0 * U[:, 0] + 1.0])
    with pytest.raises(InputError, match="inputs that move in proportion, excite none"):
        identify_data(Dataset.of(np.arange(200.0), u, Y), ModelForm(model, order=1))


def test_rows_that_settle_must_leave_rows_to_judge() -> None:
    data = data_of(ARX, rows=200)
    with pytest.raises(InputError, match="the held-out part needs more rows than the 100 that set the state, got 100"):
        identify_data(data, settle=100)
    with pytest.raises(InputError, match="settle must be at least 0 rows, got -1"):
        identify_data(data, settle=-1)


@pytest.mark.parametrize("model", ["oe", "armax", "bj", "narx", "noe"])
def test_only_arx_is_learned_row_by_row(model: str) -> None:
    with pytest.raises(InputError, match=f"only arx can be recursive, got {model}: leave --recursive out"):
        ModelForm(model, recursive=True)


def test_forgetting_without_a_recursive_model_is_refused() -> None:
    with pytest.raises(InputError, match=r"forgetting is of a recursive model, got 0\.9: add --recursive"):
        ModelForm(forgetting=0.9)


@pytest.fixture(scope="module")
def halves() -> tuple[Dataset, Dataset]:
    file = Path(os.environ.get("REACTORWATCH_SHARED", ROOT.parent / "shared")) / "data/cascaded_tanks/estimation.csv"
    if not file.exists():
        pytest.skip(
            f"the record of the cascaded tanks is not at {file}; name its folder's parent in REACTORWATCH_SHARED"
        )
    time, u, level = np.loadtxt(file, delimiter=",", skiprows=1).T
    return Dataset.of(time, u, level, ("u",), "x2").split(512)


@pytest.mark.parametrize("model", ["arx", "oe", "armax", "bj", "narx", "noe"])
def test_the_free_run_of_an_unseen_half_is_as_good_as_published_ones(
    model: str, halves: tuple[Dataset, Dataset]
) -> None:
    """Fitted to the whole other record, linear models have 0.588 to 0.685 V; these see half of one."""
    found = identify_data(halves[0], ModelForm(model, order=3), halves[1], settle=50)
    assert found.rmse is not None
    assert 0.5 < found.rmse.free_run < 0.8
    assert found.rmse.one_step < 0.1
