"""Commands of an operator: what is sent, what is printed, what is refused; a busy node is named."""

import json
import threading
from typing import Any

import msgspec
import pytest
from typer.testing import CliRunner

from reactorwatch.cli import bus_client
from reactorwatch.cli.main import app
from reactorwatch.cli.option_groups import ClientOptions, ProcessOptions
from reactorwatch.contract.codec import Encoded, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Baseline, BaselineCommand, CommandReply
from reactorwatch.errors import InputError
from tests.running import Command

BASELINES = [
    Baseline(id=0, what="trained", by="monitor"),
    Baseline(id=1, what="relearn", by="Anna", why="new pump", time_ns=5),
    Baseline(id=2, what="restore", by="Ben", why="old pump", time_ns=7, restored=0),
]


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """Commands that were sent, each with its name; the answer is the list of baselines, or a text."""
    commands: list[tuple[Any, ...]] = []

    def send(node: str, client: ClientOptions, name: str, command: Any) -> CommandReply:
        commands.append((node, client.name, name, command))
        listed = BASELINES if command.what == "list" else []
        return CommandReply(
            accepted=True, text=f"{command.what} by {command.by}, from the next row on", baselines=listed
        )

    monkeypatch.setattr(bus_client, "send_command", send)
    return commands


@pytest.mark.parametrize("what", ["accept", "relearn", "restore"])
def test_a_command_carries_its_author_and_reason(sent: list[tuple[Any, ...]], what: str) -> None:
    words = ["baseline", what, "--plant", "north", "--by", "Anna", "--why", "new pump"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert result.output == f"{what} by Anna, from the next row on\n"
    assert sent == [("monitor", "north", "baseline", BaselineCommand(what=what, by="Anna", why="new pump"))]


def test_restore_names_a_baseline_by_its_number_also_the_first(sent: list[tuple[Any, ...]]) -> None:
    CliRunner().invoke(app, ["baseline", "restore", "--by", "Ben", "--why", "old pump", "--id", "0"])
    ((_, _, _, command),) = sent
    assert command.HasField("id")
    assert command.id == 0


def test_the_list_is_one_line_or_one_object_a_baseline(sent: list[tuple[Any, ...]]) -> None:
    lines = CliRunner().invoke(app, ["baseline", "list"]).output.splitlines()
    assert [line.split(" from ")[0] for line in lines] == [
        "0: trained by monitor",
        "1: relearn by Anna",
        "2: restore 0 by Ben",
    ]
    assert lines[1].endswith(": new pump")
    printed = CliRunner().invoke(app, ["baseline", "list", "--json"]).output.splitlines()
    objects = [msgspec.json.decode(line) for line in printed]
    assert [(item["id"], item["what"], item["by"], item["why"]) for item in objects] == [
        (item.id, item.what, item.by, item.why) for item in BASELINES
    ]
    assert objects[2]["restored"] == 0
    assert len(sent) == 2


def test_a_mode_is_a_column_of_a_process_without_a_file() -> None:
    process = ProcessOptions(inputs=["q"], outputs=["th"]).choose(["phase,auto"]).load()
    assert process.names("mode") == ("phase", "auto")
    with pytest.raises(InputError, match="--mode needs an --output, got only the mode phase"):
        ProcessOptions().choose(["phase"])
    with pytest.raises(InputError, match="--input, --output and --mode describe a process without a file"):
        ProcessOptions("cstr").choose(["phase"])


ALARM = Alarm(alarm="shewhart/T", state=AlarmState.ALARM_STATE_UNACKNOWLEDGED, text="T is high")


class Nodes:
    """A bus with a monitor that answers; a recorder, if there is one, does not answer in time."""

    def __init__(self, recorder: bool) -> None:
        self._recorder = recorder

    def query(self, question: Encoded, timeout_s: float) -> list[Encoded]:
        if question.key.endswith("/list_alarms"):
            return [Encoded(question.key, *encode_message(CommandReply(accepted=True, alarms=[ALARM])))]
        if self._recorder:
            threading.Event().wait(timeout_s)
        return []

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("recorder", "said"),
    [
        (
            True,
            "the alarms of the recorder are missing: the recorder of plant 'cstr' did not answer within 0.1 s; "
            "give it a longer --timeout\n",
        ),
        (False, ""),
    ],
)
def test_alarms_are_listed_without_a_recorder_and_a_busy_one_is_named(
    called: Command, monkeypatch: pytest.MonkeyPatch, recorder: bool, said: str
) -> None:
    monkeypatch.setattr("reactorwatch.cli.bus_client.connect", lambda *_: Nodes(recorder))
    done = called("alarm", "list", "--json", "--timeout", "0.1")
    assert (done.returncode, done.stderr) == (0, said)
    assert json.loads(done.stdout)["alarm"] == "shewhart/T"
