"""A busy node is distinguished from one that does not run."""

import json
import threading

import pytest

from reactorwatch.contract.codec import Encoded, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, CommandReply
from tests.running import Command

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
