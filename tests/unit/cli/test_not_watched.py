"""Files that hold too little, or not all signals, are named; exit code 3 if no other could be watched."""

import csv
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reactorwatch.cli import main as cli
from tests.running import Command

ROWS = 600
OUTPUT = ("--output", "y")
BOTH = ("--input", "u", *OUTPUT)
SOUND = "sound.csv"

Columns = dict[str, Any]


def write(file: Path, columns: Columns) -> None:
    """Write columns as a table; NaN is an empty cell."""
    rows = zip(*columns.values(), strict=True)
    lines = [",".join("" if value != value else f"{value:.6g}" for value in row) for row in rows]
    file.write_text("\n".join([",".join(columns), *lines]) + "\n", encoding="utf-8")


def signals(rows: int = ROWS) -> Columns:
    """A first-order response to steps of an input, with noise."""
    rng = np.random.default_rng(3)
    u, y = np.repeat(rng.uniform(0.0, 10.0, rows // 20 + 1), 20)[:rows], np.zeros(rows)
    for row in range(1, rows):
        y[row] = 0.9 * y[row - 1] + 0.1 * u[row - 1]
    return {"time_min": np.arange(rows, dtype=float), "u": u, "y": y + 0.1 * rng.normal(size=rows)}


def irregular() -> Columns:
    return signals() | {"time_min": np.cumsum(np.random.default_rng(1).uniform(1.0, 60.0, ROWS))}


def flat_then_burst() -> Columns:
    burst = np.where(np.arange(ROWS) < 500, 0.0, np.random.default_rng(2).normal(size=ROWS))
    return signals() | {"y": burst}


def constant(name: str) -> Columns:
    return signals() | {name: [4.25] * ROWS}


def empty(name: str) -> Columns:
    return signals() | {name: [float("nan")] * ROWS}


def reactor(rows: int = ROWS, **others: float) -> Columns:
    """A record of the reactor, with some signals of one value."""
    rng = np.random.default_rng(4)
    columns: Columns = {
        "time_min": np.arange(rows) / 10.0,
        "qc": np.repeat(rng.uniform(95.0, 105.0, rows // 20 + 1), 20)[:rows],
        "C": 0.1 + 0.002 * rng.normal(size=rows),
        "T": 438.5 + 0.3 * rng.normal(size=rows),
    }
    return columns | {name: [value] * rows for name, value in others.items()}


NOTHING_TO_WATCH: dict[str, tuple[Columns, tuple[str, ...], str]] = {
    "rows at irregular times": (irregular(), OUTPUT, "do rows come one by one period?"),
    "an output that is flat in each training": (flat_then_burst(), OUTPUT, "y: it reads 0 in the whole training"),
    "an output that is flat": (constant("y"), OUTPUT, "at least one output must change"),
    "too few rows for a model": (signals(20), BOTH, "must have more than"),
    "one row": (signals(1), OUTPUT, "at least one output must change"),
    "a record that is shorter than its training": (signals(), (*BOTH, "--training-rows", "5000"), "too short"),
    "an output without a value": (empty("y"), BOTH, "y: no value of it has come"),
    "no value at all": (empty("y"), OUTPUT, "holds no sample that can be used"),
    "a training on a flat record": (signals(), (*OUTPUT, "--train", "flat.csv"), "flat.csv: at least one"),
    "a training on too few rows": (signals(), (*BOTH, "--train", "few.csv"), "few.csv: must have more"),
    "irregular rows after a sound training": (irregular(), (*OUTPUT, "--train", SOUND), "no row could be predicted"),
}
NOTHING_TO_DIAGNOSE: dict[str, tuple[Columns, tuple[str, ...], str]] = {
    "one row": (reactor(1), (), "needs at least 200 rows, got 1"),
    "too few rows": (reactor(150), (), "needs at least 200 rows, got 150"),
    "an output that is flat": (reactor(T=438.5), (), "T must vary"),
    "an output without a value": (reactor(C=float("nan")), (), "C needs at least 20 values, got 0"),
    "an input that never moves": (reactor(qc=100.0), (), "qc must move"),
    "a process without equations": (signals(), ("--process", "plain.toml"), "must have equations"),
}
NOTHING_TO_IDENTIFY: dict[str, tuple[Columns, tuple[str, ...], str]] = {
    "one row": (signals(1), BOTH, "needs more than 10 rows to fit"),
    "too few rows": (signals(12), BOTH, "rows to fit"),
    "rows at irregular times": (irregular(), BOTH, "need as many complete rows"),
    "an output that is flat": (constant("y"), BOTH, "output y is constant, 4.25 in all rows to fit"),
    "an input that never moves": (constant("u"), BOTH, "input u never moves, 4.25 in all rows to fit"),
    "an output without a value": (empty("y"), BOTH, "y has no measured value"),
    "an order beyond the rows": (signals(), (*BOTH, "--order", "150"), "needs more than 451 rows to fit"),
    "an input that never moves, of many models": (constant("u"), (*BOTH, "--compare"), "input u never moves"),
    "an output that is flat, of many models": (constant("y"), (*BOTH, "--compare"), "output y is constant"),
}


def cases(kinds: dict[str, tuple[Columns, tuple[str, ...], str]], command: str) -> list[object]:
    return [pytest.param(command, *kind, id=f"{command}: {name}") for name, kind in kinds.items()]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, columns in {SOUND: signals(), "flat.csv": constant("y"), "few.csv": signals(20)}.items():
        write(tmp_path / name, columns)
    roles = "".join(
        f'[[signals]]\nname = "{name}"\nrole = "{role}"\n' for name, role in (("u", "input"), ("y", "output"))
    )
    (tmp_path / "plain.toml").write_text(f'name = "plain"\n{roles}')
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("command", "columns", "options", "why"),
    [
        *cases(NOTHING_TO_WATCH, "backtest"),
        *cases(NOTHING_TO_DIAGNOSE, "diagnose"),
        *cases(NOTHING_TO_IDENTIFY, "identify"),
    ],
)
def test_a_record_that_holds_too_little_ends_with_3_and_one_line_with_the_reason(
    command: str, columns: Columns, options: tuple[str, ...], why: str, folder: Path, called: Command
) -> None:
    write(folder / "run.csv", columns)
    rows = ("--rows", "rows.csv") if command == "backtest" else ()
    for as_json in (("--json",), ()):
        ended = called(command, "run.csv", *options, *rows, *as_json)
        assert ended.returncode == 3, ended.stderr
        lines = [line for line in ended.stderr.splitlines() if " remark: " not in line]
        assert len(lines) == 1
        assert why in lines[0]
        if as_json:
            (found,) = map(json.loads, ended.stdout.splitlines())
            assert found["watched"] is False
            assert why in found["why"]
        else:
            assert "\nno alarms" not in ended.stdout
        assert not (folder / "rows.csv").exists()


def test_of_several_files_each_line_states_whether_it_was_monitored_and_one_that_was_is_enough(
    folder: Path, called: Command
) -> None:
    write(folder / "irregular.csv", irregular())
    ended = called("backtest", "irregular.csv", SOUND, "flat.csv", *OUTPUT, "--jobs", "1", "--json", "--rows", "r.csv")
    assert ended.returncode == 0
    found = {item["file"]: item["watched"] for item in map(json.loads, ended.stdout.splitlines())}
    assert found == {"irregular.csv": False, SOUND: True, "flat.csv": False}
    with (folder / "r.csv").open(encoding="utf-8", newline="") as rows:
        assert {row["file"] for row in csv.DictReader(rows)} == {SOUND}
    ended = called("backtest", "irregular.csv", SOUND, "flat.csv", *OUTPUT, "--jobs", "1", "-o", "out")
    assert ended.returncode == 0
    assert "3 files: 0 with alarms, 1 without, 2 not watched, 0 failed" in ended.stdout
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert (summary["files"], summary["failed"], summary["not_watched"]) == (3, 0, 2)
    assert [(row["watched"], bool(row["error"])) for row in summary["results"]] == [
        (False, True),
        (True, False),
        (False, True),
    ]


UNWATCHED_AND = {
    "an unreadable file": (("irregular.csv", "broken.csv"), 2),
    "an unwatched one": (("irregular.csv", "flat.csv"), 3),
    "the same one": (("irregular.csv", "irregular.csv"), 3),
}


@pytest.mark.parametrize(("files", "code"), UNWATCHED_AND.values(), ids=UNWATCHED_AND)
def test_without_a_watched_file_the_code_is_3_but_2_where_one_cannot_be_read(
    files: tuple[str, ...], code: int, folder: Path, called: Command
) -> None:
    write(folder / "irregular.csv", irregular())
    (folder / "broken.csv").write_text("time_min,u,y\n0,1,what\n")
    for as_json in (("--json",), ()):
        ended = called("backtest", *files, *OUTPUT, "--jobs", "1", *as_json)
        assert ended.returncode == code
        assert all(f"reactorwatch: {file}: " in ended.stderr.replace(", row", ": row") for file in files)


BAD_USE: dict[str, Callable[[str], tuple[str, ...]]] = {
    "a column that is not there": lambda command: (command, SOUND, "--column", "T=gone"),
    "a file that is not there": lambda command: (command, "gone.csv"),
    "a process that is not there": lambda command: (command, SOUND, "--process", "gone.toml"),
}


@pytest.mark.parametrize("command", ["backtest", "diagnose", "identify"])
@pytest.mark.parametrize("words", BAD_USE.values(), ids=BAD_USE)
def test_bad_input_and_use_end_with_2_and_print_no_result(
    command: str, words: Callable[[str], tuple[str, ...]], folder: Path, called: Command
) -> None:
    ended = called(*words(command), "--json")
    assert (ended.returncode, ended.stdout) == (2, "")


Typed = Callable[[list[str]], object]


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Records without values of one signal, and one with the input alone."""
    folder = tmp_path_factory.mktemp("records")
    generator = np.random.default_rng(1)
    qc = np.repeat(generator.uniform(90, 111, 60), 10)
    columns = {
        "qc": qc,
        "C": 0.1 + 0.002 * generator.normal(size=qc.size),
        "T": 438.5 + 0.3 * generator.normal(size=qc.size),
    }
    for name, missing in {"no_qc": ["qc"], "no_C": ["C"], "no_T": ["T"], "only_qc": ["C", "T"]}.items():
        lines = ["time_min,qc,C,T"]
        for row in range(qc.size):
            cells = ("" if signal in missing else f"{values[row]:.6g}" for signal, values in columns.items())
            lines.append(f"{row / 10:g},{','.join(cells)}")
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture
def main(monkeypatch: pytest.MonkeyPatch) -> Typed:
    """RunColumns a command; returns its exit code."""

    def run(words: list[str]) -> object:
        monkeypatch.setattr(sys, "argv", ["reactorwatch", *words])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return end.value.code

    return run


@pytest.mark.parametrize(("signal", "kind"), [("T", "csv"), ("qc", "mcap")])
def test_backtest_names_the_signal_that_has_no_value_and_watches_the_others(
    signal: str,
    kind: str,
    records: Path,
    tmp_path: Path,
    main: Typed,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = records / f"no_{signal}.csv"
    if kind == "mcap":
        file = tmp_path / f"no_{signal}.mcap"
        assert main(["import", str(records / f"no_{signal}.csv"), "-o", str(file)]) == 0
        capsys.readouterr()
    assert main(["backtest", str(file), "--training", "40", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["signals"]["left_out"] == [{"signal": signal, "why": "no value of it has come"}]
    assert found["signals"]["inputs"] == [name for name in ("qc",) if name != signal]
    assert found["signals"]["outputs"] == [name for name in ("C", "T") if name != signal]
    assert found["trained_until_min"] == 40.0
    assert main(["backtest", str(file), "--training", "1000"]) == 3
    assert f"  {signal} is not watched: no value of it has come" in capsys.readouterr().out


def test_backtest_without_any_output_is_refused_with_the_file(
    records: Path, main: Typed, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["backtest", str(records / "only_qc.csv")]) == 3
    told = capsys.readouterr().err
    assert "only_qc.csv: there is no output to watch (C: no value of it has come; T: no value of it has come)" in told
    assert "Traceback" not in told


@pytest.mark.parametrize(
    ("record", "signal", "output", "options"),
    [("no_T", "T", "T", []), ("no_C", "C", "C", ["--compare"]), ("no_qc", "qc", "T", ["--model", "oe"])],
)
def test_identify_names_the_signal_that_has_no_value_and_the_file(
    record: str,
    signal: str,
    output: str,
    options: list[str],
    records: Path,
    main: Typed,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["identify", str(records / f"{record}.csv"), "--output", output, *options]) == 3
    told = " ".join(capsys.readouterr().err.split())
    assert f"{record}.csv: {signal} has no measured value, so no model of {output} can be fitted" in told


def test_backtest_reports_why_no_training_was_fit_and_does_not_blame_its_length(
    main: Typed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rows at random times, watched by the identified model, which needs one period."""
    generator = np.random.default_rng(2)
    times_min = np.cumsum(generator.uniform(0.02, 0.3, 800))
    rows = [
        f"{at:.6f},{100 + noise:.4f},{0.1 + 0.001 * noise:.6f},{438 + noise:.4f}"
        for at, noise in zip(times_min, generator.normal(size=800), strict=True)
    ]
    (tmp_path / "irregular.csv").write_text("\n".join(["time_min,qc,C,T", *rows]) + "\n")
    (tmp_path / "arx.toml").write_text('[monitor]\nreference = "arx"\n')
    command = ["backtest", str(tmp_path / "irregular.csv"), "--config", str(tmp_path / "arx.toml"), "--training", "30"]
    assert main(command) == 3
    told = capsys.readouterr().out
    assert "nothing was watched: no training was fit to learn from" in told
    assert "do rows come one by one period?" in told
    assert "too short" not in told
