"""Nothing that a terminal would act on is printed, whatever files and the bus hold."""

import ast
import json
import re
import shlex
import sys
import unicodedata
from pathlib import Path

import pytest
import structlog
from hypothesis import given
from hypothesis import strategies as st

from reactorwatch.cli.alarm import _alarm_line
from reactorwatch.cli.display import _escape_markup, print_lines
from reactorwatch.cli.main import main
from reactorwatch.cli.status import StatusBoard, _text
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import ALARM_STATE_UNACKNOWLEDGED, QUALITY_GOOD, Alarm, Sample
from reactorwatch.runtime.node_main import configure_log
from reactorwatch.terminal import printable, printable_lines
from recorder import RecordedMessage
from recorder.files.writer import RecordingWriter

ROOT = Path(__file__).parents[2]
HOSTILE = "\x1b[2J\x1b]0;title\x07 a\r\nb\tc\x7f\x9b31m\u202eevil\u2066\u200b\u2028\u2029\ufeff\U000e0041"
BORDER = {"node_main.py", "display.py", "replay.py"}


def acted_on(text: str) -> list[str]:
    """The letters in a text that a terminal would act on, but for the ends of lines."""
    harmless = ("Zs",)  # spaces of all widths
    return [
        letter
        for letter in text
        if not letter.isprintable() and letter != "\n" and unicodedata.category(letter) not in harmless
    ]


@given(st.text())
def test_what_is_printable_is_one_line_and_what_is_harmless_stays(text: str) -> None:
    shown = printable(text)
    assert acted_on(shown) == []
    assert "\n" not in shown
    assert printable("Zürich 12 °C, µ ± ≥ 温度") == "Zürich 12 °C, µ ± ≥ 温度"


@given(st.dictionaries(st.text(), st.text() | st.floats(allow_nan=False)))
def test_a_json_document_stays_one_and_means_the_same(found: dict[str, object]) -> None:
    assert json.loads(printable(json.dumps(found, ensure_ascii=False))) == found


@given(st.lists(st.text(), min_size=1))
def test_each_line_stays_one(lines: list[str]) -> None:
    assert printable_lines(lines).count("\n") == len(lines) - 1


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording in which every name and text is hostile, and a record with a hostile name."""
    name = HOSTILE.replace("/", "").replace("\U000e0041", "")
    with RecordingWriter(tmp_path / "hostile.mcap", {"plant": name, "seed": HOSTILE, "started": HOSTILE}) as writer:
        for row in range(30):
            time_ns = 10**18 + row * 6 * 10**9
            alarm = Alarm(
                time_ns=time_ns,
                alarm=f"ewma/{HOSTILE}",
                state=ALARM_STATE_UNACKNOWLEDGED,
                event="raised",
                raised_ns=time_ns,
                text=HOSTILE,
                by=HOSTILE,
                comment=HOSTILE,
            )
            sample = Sample(time_ns=time_ns, sequence=3 * row, value=1.0, quality=QUALITY_GOOD, unit=HOSTILE)
            for kind, message in (("sample", sample), ("alarm", alarm)):
                body = encode(Publication(f"reactor/x/{kind}/T", message))
                writer.write(RecordedMessage(f"reactor/{name}/{kind}/T", body.payload, body.encoding, time_ns, time_ns))
    (tmp_path / f"{name}.csv").write_text(f"time_min,qc,C,T\n0,1,2,{name}\n", newline="")
    (tmp_path / "header.csv").write_text('time_min,qc,C,"' + HOSTILE + '"\n0,1,2,3\n', newline="")
    (tmp_path / "bad.toml").write_text("[monitor]\n" + json.dumps(HOSTILE[:20]) + " = 1\n")
    (tmp_path / "model.json").write_text(json.dumps({"format": HOSTILE, "model": HOSTILE}))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "typed",
    [
        *("info hostile.mcap", "info hostile.mcap --json", "export hostile.mcap -o FILE.csv", "backtest FILE.csv"),
        *("recover hostile.mcap -o FILE.mcap", "recover hostile.mcap -o b.mcap --json", "backtest hostile.mcap"),
        *("cut hostile.mcap -o FILE.mcap", "identify header.csv"),
        *("backtest FILE.csv header.csv --jobs 1", "backtest header.csv --config bad.toml", "info FILE", "FILE"),
        *(
            "simulate header.csv -o a.csv --model model.json",
            "charts design FILE --arl0 370 --shift 1",
        ),
        *(
            "replay hostile.mcap --verify --config bad.toml",
            "replay hostile.mcap --endpoint tcp/127.0.0.1:1",
            "info --FILE",
        ),
    ],
)
def test_no_command_sends_a_terminal_what_it_would_act_on(
    folder: Path, typed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    name = HOSTILE.replace("/", "").replace("\U000e0041", "")
    words = [word.replace("FILE", name) for word in shlex.split(typed)]
    monkeypatch.setattr(sys, "argv", ["reactorwatch", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    shown = capsys.readouterr()
    assert acted_on(shown.out) == acted_on(shown.err) == []
    assert re.search(r"\\(u00|x)1b", shown.out + shown.err)
    assert ended.value.code != 2 or shown.err.count("\n") == (2 if "--jobs" in typed else 1)


def test_alarms_and_status_from_the_bus_are_shown_and_not_sent(capsys: pytest.CaptureFixture[str]) -> None:
    alarm = Alarm(alarm=HOSTILE, state=ALARM_STATE_UNACKNOWLEDGED, text=HOSTILE, by=HOSTILE, comment=HOSTILE)
    print_lines(_alarm_line(alarm))
    board = StatusBoard(0)
    body = encode(Publication("reactor/x/alarm/T", alarm))
    board.on_message(Encoded(f"reactor/{HOSTILE.replace('/', '')}/alarm/T", body.payload, body.encoding))
    print_lines(*_text(board, as_json=False).split("\n"))
    shown = capsys.readouterr().out
    assert acted_on(shown) == []
    assert shown.splitlines()[0].count("\\u001b[2J") == 4


def test_logs_for_people_are_lines_of_text(capsys: pytest.CaptureFixture[str]) -> None:
    configure_log()
    structlog.get_logger().warning(HOSTILE, key=HOSTILE, path=Path(HOSTILE), **{HOSTILE: 1})
    shown = capsys.readouterr().err
    assert acted_on(shown) == []
    assert shown.count("\n") == 1


def test_what_is_under_way_is_no_markup() -> None:
    assert _escape_markup("reading [red]a\x1b[31m.csv") == "reading \\[red]a\\u001b[31m.csv"


def test_nothing_is_printed_but_at_the_border() -> None:
    """A new command that prints by itself fails here."""
    found = []
    for folder in ("reactorwatch", "plant_node", "monitor_node", "recorder", "diagnosis_node"):
        assert (ROOT / folder).is_dir()
        for path in (ROOT / folder).rglob("*.py"):
            if path.name in BORDER:
                continue
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call):
                    called = ast.unparse(node.func)
                    if called in ("typer.echo", "print") or called.endswith(("stdout.write", "stderr.write")):
                        found.append(f"{path.relative_to(ROOT)}: {called}")
    assert found == []
