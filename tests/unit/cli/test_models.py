"""`identify` and `linearise` print what the contract promises, as text and as JSON."""

import json
from pathlib import Path

import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.cli import identify
from reactorwatch.cli.linearise import describe
from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError
from reactorwatch.identification.identify import ModelForm
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record
from tests.tables import read_csv

TWO = ModelForm(order=2)


@pytest.fixture(scope="module")
def measured() -> Record:
    return simulate_record(PlantConfig(seed=5), 1500)


def identified(measured: Record, **options: object) -> dict[str, object]:
    form = ModelForm(**options)  # type: ignore[arg-type]
    said: dict[str, object] = json.loads(identify.fit(measured, ("qc",), ("T",), form, as_json=True))
    return said


def test_identify_prints_the_object_of_the_contract(measured: Record) -> None:
    said = identified(measured)
    assert set(said) == {
        *("model", "order", "delay", "output", "rows", "recursive"),
        *("a", "b", "offset", "sd", "fit_percent", "whiteness_minus_log10_p", "checks"),
    }
    assert said["rows"] == 750
    assert len(said["a"]) == len(said["b"]) == 3  # type: ignore[arg-type]
    assert set(said["fit_percent"]) == {"one_step", "free_run"}  # type: ignore[call-overload]


def test_arx_is_least_squares_in_the_file_s_own_units(daisy_csv: Path) -> None:
    """Parameters and fits against numpy.linalg.lstsq and a recursion written out here."""
    record = read_csv(daisy_csv)
    y, u = record.columns["T"], record.columns["qc"]
    half = y.size // 2
    k = np.arange(3, half)
    A = np.column_stack([*(y[k - lag] for lag in (1, 2, 3)), *(u[k - lag] for lag in (1, 2, 3)), np.ones(k.size)])
    truth = np.linalg.lstsq(A, y[k], rcond=None)[0]
    said = identified(record)
    ours = np.array([*said["a"], *said["b"], said["offset"]])  # type: ignore[misc]
    assert np.allclose(ours, truth, rtol=1e-6)
    run = y[half:].copy()
    for row in range(3, run.size):
        past = u[half + row - 3 : half + row][::-1]
        run[row] = truth[:3] @ run[row - 3 : row][::-1] + truth[3:6] @ past + truth[6]
    held_out, run = y[half + 3 :], run[3:]
    fit = 100 * (1 - np.linalg.norm(held_out - run) / np.linalg.norm(held_out - held_out.mean()))
    assert said["fit_percent"]["free_run"] == pytest.approx(fit, abs=0.05)  # type: ignore[index]


def test_row_by_row_gives_what_all_rows_at_once_give(measured: Record) -> None:
    once, by_row = identified(measured), identified(measured, recursive=True)
    assert np.allclose(once["a"], by_row["a"], rtol=1e-6)  # type: ignore[arg-type]
    assert by_row["recursive"] is True


def test_compare_names_the_chosen_model_and_the_reason(measured: Record) -> None:
    text = identify.compare(measured, ("qc",), ("C",), 2, 1, as_json=False)
    assert text.splitlines()[-1].endswith(".")
    said = json.loads(identify.compare(measured, ("qc",), ("C",), 2, 1, as_json=True))
    assert {(item["family"], item["order"]) for item in said["candidates"]} == {
        ("arx", 1), ("arx", 2), ("oe", 1), ("oe", 2),
    }  # fmt: skip
    assert said["chosen"]["family"] in ("arx", "oe")
    assert said["reason"]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"order": 0}, "order must be at least 1, got 0"),
        ({"delay": -1}, r"delay \(samples\) must be at least 1, got -1"),
        ({"model": "fir"}, "unknown model 'fir'"),
        ({"order": 500}, "rows"),
    ],
)
def test_options_that_make_no_model_are_refused(measured: Record, options: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        identified(measured, **options)


def test_linearise_prints_the_table_of_the_plant() -> None:
    """Eigenvalues as published for qc = 100 and 85 l/min."""
    points = json.loads(describe(cstr(), [100.0], 1.0, as_json=True))["steady_states"]
    assert [point["kind"] for point in points] == ["stable node", "saddle", "stable focus"]
    (re, im), _ = points[-1]["eigenvalues_per_min"]
    assert (round(re, 3), round(abs(im), 3)) == (-1.983, 3.059)
    overdamped = json.loads(describe(cstr(), [85.0], 1.0, as_json=True))["steady_states"][-1]
    assert [round(re, 3) for re, _ in overdamped["eigenvalues_per_min"]] == [-8.769, -2.987]
    assert points[1]["step_error"] is None
    assert 0 < points[2]["step_error"]["T"] < 0.02


@pytest.mark.parametrize(("qc", "step", "text"), [(-1.0, 1.0, "qc must be in"), (100.0, 0.0, "--step must not be 0")])
def test_a_flow_or_step_that_cannot_be_is_refused(qc: float, step: float, text: str) -> None:
    with pytest.raises(InputError, match=text):
        describe(cstr(), [qc], step, as_json=False)


def test_linearise_takes_a_level_of_each_input_of_any_process() -> None:
    """The tanks at the base flows of their controllers rest at the set points; one error for each input and output."""
    model = find_process("three_tanks").require_model()
    found = json.loads(describe(model, [31.8605, 27.5668], None, as_json=True))
    assert (found["Q1"], found["Q2"]) == (31.8605, 27.5668)
    (point,) = found["steady_states"]
    assert (point["state"]["h1"], point["state"]["h2"]) == pytest.approx((40.0, 20.0), abs=1e-3)
    assert {name: list(errors) for name, errors in point["step_error"].items()} == {
        "Q1": ["h1", "h2", "h3"],
        "Q2": ["h1", "h2", "h3"],
    }
    assert "a step of 0.5 cm3/s in Q2" in describe(model, [31.8605, 27.5668], None, as_json=False)
    with pytest.raises(InputError, match=r"^three_tanks: one level for each input is needed \(Q1, Q2\), got 1$"):
        describe(model, [30.0], None, as_json=False)
