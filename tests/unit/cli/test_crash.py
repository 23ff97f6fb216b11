"""Internal errors: one line, the path of a report, exit code 70; no known input leads to one."""

import re
import shlex
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.api import diagnosis
from reactorwatch.cli.main import main
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication, encode
from reactorwatch.contract.messages_pb2 import QUALITY_GOOD, Sample
from reactorwatch.errors import InputError
from reactorwatch.records.write import write_table
from reactorwatch.runtime import node_main as crash
from reactorwatch.runtime.config import read_settings
from recorder import RecordedMessage
from recorder.config import RecorderConfig
from recorder.files.writer import RecordingWriter
from tests.unit.diagnosis.cases import CASES

Shown = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch
ROWS = 300


def run(typed: list[str], monkeypatch: Patch) -> object:
    """The exit code of a command line."""
    monkeypatch.setattr(sys, "argv", ["reactorwatch", *typed])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record, and recordings of plants whose names no plant of ours can have."""
    folder = tmp_path_factory.mktemp("files")
    write_table(folder / "good.csv", simulate_record(PlantConfig(seed=1), ROWS))
    for number, plant in enumerate(("cstr", *IMPOSSIBLE)):
        with RecordingWriter(folder / f"plant{number}.mcap", {"plant": plant}) as writer:
            for row in range(ROWS):
                time_ns = 10**18 + row * 6 * 10**9
                for signal, value in (("qc", 103.0 + row // 20 % 2), ("C", 0.1), ("T", 438.0 + row % 3 / 10)):
                    sample = Sample(time_ns=time_ns, sequence=row, value=value, quality=QUALITY_GOOD)
                    message = encode(Publication(f"reactor/x/sample/{signal}", sample))
                    topic = f"reactor/{plant}/sample/{signal}"
                    writer.write(RecordedMessage(topic, message.payload, message.encoding, time_ns, time_ns))
    return folder


IMPOSSIBLE = ("a b", "a*", "..", "x" * 300, "ü", "a\nb", "a\x1b[31mb", "$", "a#", "@fleet", "-a")


@pytest.fixture
def folder(files: Path, tmp_path: Path, monkeypatch: Patch) -> Path:
    """An empty folder to be in, with links to the files; crash reports would be in `reports` in it."""
    for file in files.iterdir():
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "reports").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "reports"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def crashing(*_: object, **__: object) -> None:
    raise RuntimeError("the wrong\nreactor " + "x" * 1000)


@pytest.mark.parametrize("typed", ["info plant0.mcap", "linearise 100", "charts design ewma --arl0 370 --shift 1"])
def test_an_unexpected_error_is_one_line_with_the_path_of_a_report(
    folder: Path, typed: str, monkeypatch: Patch, capsys: Shown
) -> None:
    for name in (
        "recorder.tools.inspect.inspect",
        "reactorwatch.cli.linearise.describe",
        "reactorwatch.spc.charts.ewma.Ewma.fastest",
    ):
        monkeypatch.setattr(name, crashing)
    assert run(shlex.split(typed), monkeypatch) == crash.EXIT_CODE == 70
    shown = capsys.readouterr()
    assert (shown.out, shown.err.count("\n")) == ("", 1)
    assert len(shown.err) < 600
    (report,) = (folder / "reports").iterdir()
    assert str(report) in shown.err
    assert report.stat().st_mode & 0o077 == 0
    text = report.read_text()
    assert "Traceback (most recent call last)" in text
    assert "test_crash.py" in text
    assert repr(typed.split()[-1]) in text


def test_where_no_report_can_be_written_the_line_names_the_place(
    folder: Path, monkeypatch: Patch, capsys: Shown
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(folder / "nowhere"))
    monkeypatch.setattr("recorder.tools.inspect.inspect", crashing)
    assert run(["info", "plant0.mcap"], monkeypatch) == crash.EXIT_CODE
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert re.search(r"test_crash\.py:\d+", said)


def refused(typed: str, folder: Path, monkeypatch: Patch, capsys: Shown) -> str:
    """RunColumns what must be refused in one line, leaving nothing; returns the line."""
    before = sorted(folder.rglob("*"))
    assert run(shlex.split(typed), monkeypatch) == 2
    shown = capsys.readouterr()
    assert (shown.out, shown.err.count("\n")) == ("", 1)
    assert sorted(folder.rglob("*")) == before
    return shown.err


RECORDS: dict[str, tuple[int, Callable[[int], float]]] = {
    "times of a clock as minutes": (0, lambda row: 1.7e9 + 0.1 * row),
    "nanoseconds as minutes": (0, lambda row: 1.7e18 + 6e9 * row),
    "times of 1e300": (0, lambda row: 1e300 * (row + 1)),
    "times of 1e295": (0, lambda row: 1e295 * row),
    "times of -1e9": (0, lambda row: -1e9 + row),
    "input of 1e308": (1, lambda row: 1e308 if row == 150 else 103.0),
    "output of -1e308": (2, lambda row: -1e308 if row == 0 else 0.1),
    "output of 1e15": (3, lambda row: 1e15 if row == 299 else 438.0),
}
READING = ("import {} -o x.mcap", "simulate {} -o x.csv", "backtest {}", "identify {}", "diagnose {} -o report")


@pytest.mark.parametrize("command", [*READING, "dashboard {} -o x.rrd"])
@pytest.mark.parametrize("record", RECORDS)
def test_times_and_values_that_cannot_be_are_one_line_in_every_command_that_reads_a_record(
    folder: Path, record: str, command: str, monkeypatch: Patch, capsys: Shown
) -> None:
    column, value_of = RECORDS[record]
    rows: list[list[float]] = [[0.1 * row, 103.0 + row // 20 % 2, 0.1, 438.0] for row in range(ROWS)]
    for row, cells in enumerate(rows):
        cells[column] = value_of(row)
    lines = ["time_min,qc,C,T", *(",".join(map(repr, cells)) for cells in rows)]
    (folder / "bad.csv").write_text("\n".join(lines) + "\n")
    said = refused(command.format("bad.csv"), folder, monkeypatch, capsys)
    assert re.search(r"bad\.csv, row \d+, column '(time_min|qc|C|T)': expected", said)


TOML = {
    "thousands of digits": "[monitor]\norder = " + "1" * 5000 + "\n",
    "a deep list": "[monitor]\ncharts = " + "[" * 5000 + "]" * 5000 + "\n",
    "a deep table": "[monitor]\ncharts = " + "{a = " * 5000 + "1" + "}" * 5000 + "\n",
    "a deep name": "[" + ".".join(["monitor"] * 3000) + "]\n",
    "twenty megabytes": "[monitor]\n" + "#" * 20_000_000 + "\n",
    "no tables": "monitor = 3\n",
    "a number for a list": "[monitor]\ncharts = 1e308\n",
}


@pytest.mark.parametrize("text", TOML.values(), ids=TOML.keys())
def test_settings_of_any_size_and_depth_are_one_line(
    folder: Path, text: str, monkeypatch: Patch, capsys: Shown
) -> None:
    (folder / "bad.toml").write_text(text)
    assert "settings" in refused("backtest good.csv --config bad.toml", folder, monkeypatch, capsys)


def test_a_byte_order_mark_is_read_over(tmp_path: Path) -> None:
    (tmp_path / "settings.toml").write_text("\ufeff[monitor]\norder = 2\n", encoding="utf-8")
    assert read_settings(tmp_path / "settings.toml") == {"monitor": {"order": 2}}


@pytest.mark.parametrize("span", ["9" * 30 + "h", "9" * 400 + "s", "1281024h", "99999999999min"])
@pytest.mark.parametrize(
    "command",
    [
        "cut plant0.mcap -o x.mcap --from {}",
        "cut plant0.mcap -o x.mcap --to {}",
        "replay plant0.mcap --from {} --endpoint tcp/127.0.0.1:1",
    ],
)
def test_spans_longer_than_any_record_are_one_line(
    folder: Path, command: str, span: str, monkeypatch: Patch, capsys: Shown
) -> None:
    assert "must be at most 146 years" in refused(command.format(span), folder, monkeypatch, capsys)


@given(st.text(st.sampled_from("ab*$/#?@ü "), max_size=12))
def test_key_expressions_are_those_that_the_bus_takes(text: str) -> None:
    try:
        zenoh.KeyExpr(text)
    except zenoh.ZError:
        with pytest.raises(ValueError, match="key_expression must be"):
            keys.check_expression(text)
    else:
        assert keys.check_expression(text) == text


@pytest.mark.parametrize("text", ["reactor/**bad**", "", "/", "a//b", "a#b", "**/**"])
def test_a_bad_key_expression_is_refused_before_a_router_is_looked_for(
    folder: Path, text: str, monkeypatch: Patch, capsys: Shown
) -> None:
    (folder / "bad.toml").write_text(f'[recorder]\nkey_expression = "{text}"\n')
    said = refused("record --config bad.toml --endpoint tcp/127.0.0.1:1", folder, monkeypatch, capsys)
    assert "settings [recorder]: key_expression must be" in said
    assert RecorderConfig(key_expression="reactor/north_$*/**").key_expression == "reactor/north_$*/**"


@pytest.mark.parametrize("number", range(1, len(IMPOSSIBLE) + 1))
def test_a_recording_of_a_plant_with_an_impossible_name_is_watched_under_no_name(
    folder: Path, number: int, monkeypatch: Patch, capsys: Shown
) -> None:
    for command in ("backtest {}", "replay {} --endpoint tcp/127.0.0.1:1"):
        said = refused(command.format(f"plant{number}.mcap"), folder, monkeypatch, capsys)
        assert f"plant{number}.mcap: plant name must be" in said
    for command in ("info {}", "export {} -o {}.csv", "simulate {} -o {}.csv"):
        assert run(shlex.split(command.format(*[f"plant{number}.mcap"] * 2)), monkeypatch) == 0
    capsys.readouterr()


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize(
    "fails",
    [
        "reactorwatch.diagnosis.report.page.as_page",
        "reactorwatch.api.diagnosis.DiagnosisResult.to_dict",
        "reactorwatch.cli.diagnose.write_extended_model",
        "reactorwatch.cli.diagnose.write_drawing",
    ],
)
def test_a_report_that_cannot_be_made_leaves_no_half_of_it(
    folder: Path, fails: str, there: bool, monkeypatch: Patch, capsys: Shown
) -> None:
    monkeypatch.setattr(diagnosis, "find_causes", lambda *_: CASES["ambiguous"])
    monkeypatch.setattr(fails, crashing)
    if there:
        (folder / "report").mkdir()
        (folder / "report" / "report.json").write_text("{}")
    before = {path: path.read_bytes() for path in (folder / "report").rglob("*")}
    assert run(["diagnose", "good.csv", "-o", "report"], monkeypatch) == 70
    assert capsys.readouterr().out == ""
    assert {path: path.read_bytes() for path in (folder / "report").rglob("*")} == before
    assert (folder / "report").exists() == there


def test_an_input_error_is_not_a_crash(folder: Path, monkeypatch: Patch, capsys: Shown) -> None:
    def refuse(*_: object) -> None:
        raise InputError("no such reactor")

    monkeypatch.setattr("recorder.tools.inspect.inspect", refuse)
    assert run(["info", "plant0.mcap"], monkeypatch) == 2
    assert capsys.readouterr().err == "reactorwatch: no such reactor\n"
    assert not list((folder / "reports").iterdir())
