"""`identify` on any described process: by file, by name and by columns."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import reactorwatch as rw
from reactorwatch.cli import main as cli
from reactorwatch.cli.main import app
from tests.unit.identification.truth import ARX

TOML = """
name = "exchanger"
[time]
column = "ts"
[[signals]]
name = "q1"
role = "input"
[[signals]]
name = "q2"
role = "input"
[[signals]]
name = "th"
role = "output"
unit = "degC"
[[signals]]
name = "tc"
role = "output"
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a process, a record of it and another record to validate on."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "exchanger.toml").write_text(TOML)
    for name, seed in (("rig", 1), ("other", 2)):
        u, y = ARX.simulate(400, seed)
        tc = 3.0 + np.convolve(u[:, 0], [0.0, 0.5, 0.2])[:400] + 0.1 * np.random.default_rng(seed).standard_normal(400)
        rows = zip(np.arange(400.0) * 4.0, u[:, 0], u[:, 1], y, tc, strict=True)
        lines = ["ts,q1,q2,th,tc", *(",".join(f"{value:.9g}" for value in row) for row in rows)]
        (tmp_path / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return tmp_path


def identified(*words: str) -> list[dict[str, Any]]:
    result = CliRunner().invoke(app, ["identify", "rig.csv", "--order", "2", "--json", *words], standalone_mode=False)
    assert result.exception is None, result.exception
    return [json.loads(line) for line in result.stdout.splitlines()]


def test_all_outputs_of_a_file_are_identified_one_object_a_line() -> None:
    assert [found["output"] for found in identified("--process", "exchanger.toml")] == ["th", "tc"]


@pytest.mark.parametrize("words", [["--output", "tc", "--output", "th"], ["--output", "tc, th"]])
def test_the_outputs_named_are_identified_in_their_order(words: list[str]) -> None:
    assert [found["output"] for found in identified("--process", "exchanger.toml", *words)] == ["tc", "th"]


@pytest.mark.parametrize("model", ["arx", "oe", "armax", "bj", "narx", "noe"])
def test_columns_describe_the_same_process_as_a_file(model: str) -> None:
    named = identified("--process", "exchanger.toml", "--output", "th", "--model", model)
    columns = identified("--time", "ts", "--input", "q1,q2", "--output", "th", "--model", model)
    assert columns == named
    assert set(columns[0]["b"]) == {"q1", "q2"}


def test_one_input_and_none_keep_the_list() -> None:
    (one,) = identified("--input", "q1", "--output", "tc")
    assert np.shape(one["b"]) == (2,)
    (none,) = identified("--output", "th")
    assert none["b"] == []
    assert np.shape(none["a"]) == (2,)


def test_another_file_validates_and_settled_rows_are_left_out() -> None:
    words = ["--process", "exchanger.toml", "--output", "th", "--validate", "other.csv", "--settle", "50"]
    (found,) = identified(*words)
    assert found["rows"] == 400
    assert found["rmse"]["one_step"] == pytest.approx(0.5, rel=0.2)
    assert found["rmse"]["free_run"] > found["rmse"]["one_step"]
    text = CliRunner().invoke(app, ["identify", "rig.csv", "--order", "2", *words]).stdout
    assert "fit on other.csv: one step" in text
    assert "b.q1.1" in text
    process = "exchanger.toml"
    record, other = rw.read_record("rig.csv", process), rw.read_record("other.csv", process)
    model = rw.identify(record, "th", process=process, validate=other, settle=50, order=2)
    assert [*model.a] == found["a"]
    assert model.rmse.free_run == found["rmse"]["free_run"]


def test_a_catalogue_process_is_identified_by_name(folder: Path) -> None:
    rng = np.random.default_rng(1)
    flows = np.repeat(rng.uniform(20.0, 60.0, (40, 2)), 10, axis=0)
    levels = 30.0 + np.cumsum(rng.standard_normal((400, 3)) + 0.01 * (flows[:, [0, 1, 0]] - 40.0), axis=0)
    table = np.column_stack([np.arange(400.0), flows, levels])
    np.savetxt(folder / "rig.csv", table, delimiter=",", header="time_s,Q1,Q2,h1,h2,h3", comments="")
    assert [found["output"] for found in identified("--process", "three_tanks")] == ["h1", "h2", "h3"]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--process", "exchanger.toml", "--output", "pH"], "unknown --output 'pH' (valid: th, tc)"),
        (["--process", "exchanger.toml", "--input", "q1"], "leave one of the two out"),
        (["--input", "q1"], "--input needs an --output"),
        (["--input", "q1", "--output", "q1"], "each signal must have a name of its own"),
        (["--model", "exchanger.toml"], "unknown model 'exchanger.toml' (valid: arx, oe, armax, bj, narx, noe)"),
        (["--input", "q1", "--output", "th", "--compare", "--settle", "5"], "leave --validate and --settle out"),
        (["--input", "q1", "--output", "th", "--validate", "gone.csv"], "gone.csv: there is no such file"),
        (["--input", "q1", "--output", "th", "--settle", "200"], "needs more rows than the 200 that set the state"),
        (
            ["--input", "q1", "--output", "th", "--model", "narx", "--recursive"],
            "only arx can be recursive, got narx",
        ),
    ],
)
def test_bad_input_gets_one_line(
    words: list[str], text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["reactorwatch", "identify", "rig.csv", *words])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    told = capsys.readouterr()
    assert text in " ".join(told.err.split())
    assert told.out == ""
