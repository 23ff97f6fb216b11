"""The result of `reactorwatch identify --json`."""

import math

import msgspec
import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.identification.identify import Identification
from reactorwatch.identification.linear_model import fit_percent
from tests.unit.identification.truth import Daisy, NoisyPlant, identify


def test_it_prints_the_parameters_and_fits_of_the_daisy_record(daisy: Daisy) -> None:
    """Every number against LAPACK and the recursion written out, from the unscaled columns."""
    told = identify(daisy.time, daisy.qc, daisy.T, order=3, name="T")
    half, u, y = 3750, daisy.qc, daisy.T
    k = np.arange(3, half)
    columns = [y[k - 1], y[k - 2], y[k - 3], u[k - 1], u[k - 2], u[k - 3], np.ones(k.size)]
    theta = np.linalg.lstsq(np.column_stack(columns), y[k])[0]
    np.testing.assert_allclose([*told.a, *told.b, told.offset], theta, rtol=1e-6)
    run, held_out, driven = list(y[half : half + 3]), y[half:], u[half:]
    for j in range(3, half):
        run.append(theta @ [run[j - 1], run[j - 2], run[j - 3], driven[j - 1], driven[j - 2], driven[j - 3], 1.0])
    assert told.fit_percent.free_run == pytest.approx(fit_percent(held_out[3:], run[3:]), abs=1e-3)
    assert told.fit_percent.one_step > 99.5
    assert (told.model, told.order, told.delay, told.output, told.rows) == ("arx", 3, 1, "T", half)
    assert told.checks["excitation"] == told.checks["sampling"] == "ok"
    # The reactor is not linear, the record has no noise, and so the residuals cannot be white.
    assert told.whiteness_minus_log10_p > 6.0
    assert "leaves something out" in told.checks["whiteness"]


def test_its_json_has_the_promised_names(daisy: Daisy) -> None:
    told = msgspec.json.decode(msgspec.json.encode(identify(daisy.time, daisy.qc, daisy.C, order=2, name="C")))
    promised = ["model", "order", "delay", "output", "rows", "recursive", "a", "b", "offset", "sd", "fit_percent"]
    assert list(told)[: len(promised)] == promised
    assert {"whiteness_minus_log10_p", "checks"} <= set(told)
    assert {"a", "b"} <= set(told["sd"])
    assert set(told["fit_percent"]) == {"one_step", "free_run"}
    assert len(told["a"]) == len(told["b"]) == len(told["sd"]["a"]) == 2


def parameters_of(told: Identification) -> list[float]:
    return [*told.a, *told.b, told.offset]


def test_row_by_row_it_finds_what_it_finds_at_once(noisy_plant: NoisyPlant) -> None:
    """To 1e-9 of a standard deviation."""
    time = np.arange(4000.0)
    batch = identify(time, noisy_plant.inputs, noisy_plant.measured, order=2)
    recursive = identify(time, noisy_plant.inputs, noisy_plant.measured, order=2, recursive=True)
    deviations = np.array([*batch.sd.a, *batch.sd.b, batch.sd.offset])
    difference = np.abs(np.subtract(parameters_of(recursive), parameters_of(batch)))
    assert np.all(difference < deviations * 1e-9)
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
        told = identify(time, u, y, order=2, missing="leave out", recursive=recursive)
        np.testing.assert_allclose(parameters_of(told), noisy_plant.parameters, atol=1e-8)
    batch = identify(time, u, y, model="oe", order=2, missing="leave out")
    np.testing.assert_allclose(parameters_of(batch), noisy_plant.parameters, atol=1e-3)


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
