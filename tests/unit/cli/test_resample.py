"""`--resample`: an export with tags at times of their own is identified and watched, from a table or a recording."""

import json
from pathlib import Path

import numpy as np
import pytest

import reactorwatch as rw
from reactorwatch.api.files import record_of_process
from reactorwatch.description.read import ProcessChoice
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.record import Record
from recorder.tools.convert import export_csv, import_csv
from tests.running import Command

SIGNALS = ("--input", "u", "--output", "y")
CHOICE = ProcessChoice(None, ("u",), ("y",))
TIME_CONSTANT_S = 60.0
PERIOD_S = 10.0


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A first-order plant of gain 2, exact between moves of its input: y at random times, u when it moves."""
    rng = np.random.default_rng(1)
    moves = np.cumsum(rng.exponential(80.0, 450) + 5.0)
    inputs = rng.normal(size=moves.size)
    state, at, levels = 0.0, 0.0, []
    for move, value in zip(moves, np.concatenate([[0.0], inputs[:-1]]), strict=True):
        levels.append(state := 2 * value + (state - 2 * value) * np.exp(-(move - at) / TIME_CONSTANT_S))
        at = move
    times = np.cumsum(rng.exponential(2.0, int(moves[-1] / 1.8)))
    times = times[(times > moves[0]) & (times < moves[-1])]
    last = np.searchsorted(moves, times, side="right") - 1
    held = 2 * inputs[last]
    values = held + (np.array(levels)[last] - held) * np.exp(-(times - moves[last]) / TIME_CONSTANT_S)
    values += rng.normal(scale=0.02, size=times.size)
    rows = [(at, "u", value) for at, value in zip(moves, inputs, strict=True)]
    rows += [(at, "y", value) for at, value in zip(times, values, strict=True)]
    path = tmp_path_factory.mktemp("export") / "export.csv"
    path.write_text(
        "\n".join(["seconds,tag,value", *(f"{at:.2f},{tag},{v:.5f}" for at, tag, v in sorted(rows))]) + "\n"
    )
    return path


def read(path: Path, resample: str | None = "10 s") -> Record:
    return record_of_process(path, None, {}, CHOICE, FileFormat(resample=resample))[0]


def test_the_plant_behind_an_export_by_exception_is_found(export: Path) -> None:
    """The pole of the sampled plant is exp(-P / time constant), its gain 2."""
    record = read(export)
    assert record.read_as.endswith("resampled to 10 s: u mean (held between), y mean")
    y, u = record.columns["y"], record.columns["u"]
    known = ~np.isnan(y[1:] + y[:-1] + u[:-1])
    pole, gain = np.linalg.lstsq(np.column_stack([y[:-1], u[:-1]])[known], y[1:][known], rcond=None)[0]
    assert pole == pytest.approx(np.exp(-PERIOD_S / TIME_CONSTANT_S), abs=0.01)
    assert gain / (1 - pole) == pytest.approx(2.0, abs=0.05)


def test_an_export_by_exception_is_watched_resampled_and_the_cure_is_named_without(
    export: Path, called: Command
) -> None:
    refused = called("backtest", export, *SIGNALS)
    assert refused.returncode == 3
    assert "; --resample auto, or resample in [monitor], makes them regular" in refused.stdout
    watched = called("backtest", export, *SIGNALS, "--resample", "10 s,y=interpolated")
    assert watched.returncode == 0
    assert "resampled to 10 s: u mean (held between), y interpolated" in watched.stderr
    assert "no alarms" in watched.stdout
    assert "not trustworthy" not in watched.stdout


def test_a_recording_is_resampled_as_the_table_that_it_was_made_of(
    export: Path, tmp_path: Path, called: Command
) -> None:
    recording, again = tmp_path / "export.mcap", tmp_path / "again.csv"
    import_csv(export, recording, "rig", choice=CHOICE)
    results = []
    for file in (export, recording):
        result = json.loads(called("backtest", file, *SIGNALS, "--resample", "10 s", "--json").stdout)
        results.append({name: value for name, value in result.items() if name not in ("file", "plant")})
    assert results[0] == results[1]
    exported = export_csv(recording, again, stated=FileFormat(resample="10 s"))
    table = read(export)
    for name, values in table.columns.items():
        np.testing.assert_allclose(exported.columns[name], values, rtol=1e-9)
    for command in ("info", "replay"):
        refused = called(command, recording, "--resample", "10 s")
        assert refused.returncode == 2
        assert "export it with --resample" in refused.stderr


def test_a_monitor_makes_the_rows_itself_of_a_table_and_of_its_recording(
    export: Path, tmp_path: Path, called: Command
) -> None:
    """As on the bus: both are samples, and the rows are made of their times alone."""
    recording, settings, rows = tmp_path / "export.mcap", tmp_path / "rig.toml", tmp_path / "rows.csv"
    import_csv(export, recording, "rig", choice=CHOICE)
    settings.write_text('[monitor]\nresample = "10 s"\n')
    results = []
    for file in (export, recording):
        text = called("backtest", file, *SIGNALS, "--config", settings, "--rows", rows, "--force", "--json").stdout
        result = json.loads(text)
        assert result["watched"]
        assert result["trained_until_min"] == pytest.approx(1000 / 6, abs=2.0)
        results.append({name: value for name, value in result.items() if name not in ("file", "plant")})
        assert len(rows.read_text().splitlines()) == pytest.approx(result["span_min"] * 6, abs=10)
    assert results[0] == results[1]


def test_files_in_a_row_are_joined_before_they_are_resampled(export: Path, tmp_path: Path) -> None:
    header, *rows = export.read_text().splitlines()
    parts = [tmp_path / "one.csv", tmp_path / "two.csv"]
    for part, chosen in zip(parts, (rows[:9000], rows[9000:]), strict=True):
        part.write_text("\n".join([header, *chosen]) + "\n")
    joined = rw.read_record(parts, process=CHOICE.load(), resample="10 s")
    whole = read(export)
    np.testing.assert_allclose(joined.time_min, whole.time_min)
    np.testing.assert_allclose(joined.columns["y"], whole.columns["y"])


def test_the_description_of_a_process_states_how_its_files_are_resampled(export: Path, tmp_path: Path) -> None:
    described = tmp_path / "rig.toml"
    described.write_text(
        'name = "rig"\nsignals = [{name = "u", role = "input"}, {name = "y", role = "output"}]\n'
        '[file]\nresample = "10 s,y=last"\n'
    )
    assert "u mean (held between), y last" in rw.read_record(export, process=str(described)).read_as
    assert "resampled to 20 s" in rw.read_record(export, process=str(described), resample="20 s").read_as
