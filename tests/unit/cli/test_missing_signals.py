"""A record in which a signal has no value: the commands name the signal and the file."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reactorwatch.cli import main as cli

Command = Callable[[list[str]], object]


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
def main(monkeypatch: pytest.MonkeyPatch) -> Command:
    """RunColumns a command; returns its exit code."""

    def run(words: list[str]) -> object:
        monkeypatch.setattr(sys, "argv", ["reactorwatch", *words])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return end.value.code

    return run


@pytest.mark.parametrize("kind", ["csv", "mcap"])
@pytest.mark.parametrize("signal", ["qc", "C", "T"])
def test_backtest_names_the_signal_that_has_no_value_and_watches_the_others(
    signal: str,
    kind: str,
    records: Path,
    tmp_path: Path,
    main: Command,
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
    records: Path, main: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["backtest", str(records / "only_qc.csv")]) == 3
    told = capsys.readouterr().err
    assert "only_qc.csv: there is no output to watch (C: no value of it has come; T: no value of it has come)" in told
    assert "Traceback" not in told


@pytest.mark.parametrize("options", [[], ["--compare"], ["--model", "oe"]])
@pytest.mark.parametrize(("record", "signal", "output"), [("no_T", "T", "T"), ("no_C", "C", "C"), ("no_qc", "qc", "T")])
def test_identify_names_the_signal_that_has_no_value_and_the_file(
    record: str,
    signal: str,
    output: str,
    options: list[str],
    records: Path,
    main: Command,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["identify", str(records / f"{record}.csv"), "--output", output, *options]) == 3
    told = " ".join(capsys.readouterr().err.split())
    assert f"{record}.csv: {signal} has no measured value, so no model of {output} can be fitted" in told


def test_backtest_reports_why_no_training_was_fit_and_does_not_blame_its_length(
    main: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
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
