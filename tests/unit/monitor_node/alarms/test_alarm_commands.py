"""Operators' alarm commands on the bus: done and published, or refused in one line with nothing changed.

A flood of commands is refused beyond a rate, by name and in all, and occasional commands are still served.
"""

from pathlib import Path

import pytest
from google.protobuf.message import Message
from msgspec.structs import replace

from monitor_node.alarms.commands import ALL, COMMANDS, MAX_NAMES, PER_NAME, CommandRateLimiter, sender_name
from monitor_node.config import MonitorConfig
from monitor_node.node import MonitorNode
from plant_node.node import COMMANDS as PLANT_COMMANDS
from reactorwatch.contract.codec import Encoded, Publication, decode, encode_message
from reactorwatch.contract.messages_pb2 import (
    Alarm,
    AlarmCommand,
    AlarmKpis,
    AlarmState,
    CommandReply,
    Health,
    ListAlarms,
    ShelveAlarm,
)
from reactorwatch.records.record import to_time_ns
from reactorwatch.runtime.bus import Request
from tests.memory_bus import Exchange, MemoryBus

from ..samples import PLANT, leaking_run, samples

END_MIN = 140.0
CONFIG = MonitorConfig(diagnose_training=False)
"""Each room has a node, which would start a process for the diagnosis."""


@pytest.fixture(scope="module")
def leak() -> list[Encoded]:
    """A run whose coolant leaks from minute 130 on; both alarms stand at its end."""
    return list(samples(*leaking_run(-0.1, 130.0, END_MIN, seed=1)))


@pytest.fixture(scope="module")
def alarmed(leak: list[Encoded]) -> bytes:
    """State of a monitor of that run."""
    node = MonitorNode(CONFIG, 0)
    for message in leak:
        node.on_message(message, 0)
    return node.monitor(PLANT).to_bytes()


class Room:
    """A monitor on a bus within the process, and an operator beside it.

    Args:
        config: settings of the monitor.
        state: state that the monitor resumes from; empty: it starts without one.

    Attributes:
        published: what the monitor published because of commands.
    """

    def __init__(self, config: MonitorConfig, state: bytes = b"") -> None:
        self.node = MonitorNode(config, 0)
        if state:
            self.node.monitor(PLANT).from_bytes(state)
        self.published: list[Publication] = []
        self._operator = MemoryBus(Exchange())
        self._operator.declare_queryable(f"reactor/{PLANT}/command/*", self._answer)

    def receive(self, messages: list[Encoded]) -> list[Publication]:
        """Samples come."""
        return [item for message in messages for item in self.node.on_message(message, 0)]

    def ask(self, name: str, message: Message) -> CommandReply:
        """A person asks."""
        self.published.clear()
        question = Encoded(f"reactor/{PLANT}/command/{name}", *encode_message(message))
        (answer,) = self._operator.query(question, 1.0)
        reply = decode(answer.payload, answer.encoding)
        assert isinstance(reply, CommandReply)
        return reply

    def _answer(self, request: Request) -> None:
        reply, publications = self.node.on_command(request.question, 0)
        assert reply is not None
        self.published += publications
        request.reply(reply)


@pytest.fixture
def room(alarmed: bytes) -> Room:
    return Room(CONFIG, alarmed)


def listed(room: Room) -> dict[str, Alarm]:
    """The alarms as they are, by name."""
    return {alarm.alarm: alarm for alarm in room.ask("list_alarms", ListAlarms()).alarms}


def by_anna(alarm: str = "shewhart/T", comment: str = "") -> AlarmCommand:
    return AlarmCommand(alarm=alarm, by="Anna", comment=comment)


def test_an_acknowledged_alarm_is_published_at_the_time_of_the_newest_sample(room: Room) -> None:
    reply = room.ask("acknowledge", by_anna(comment="seen"))
    assert (reply.accepted, reply.text) == (True, "alarm shewhart/T: acknowledge by Anna")
    alarm, figures = (item.message for item in room.published)
    assert isinstance(alarm, Alarm)
    assert isinstance(figures, AlarmKpis)
    assert [item.key for item in room.published] == ["reactor/cstr/alarm/shewhart/T", "reactor/cstr/alarm_kpis/monitor"]
    assert alarm.time_ns == to_time_ns(END_MIN)
    assert alarm.state == AlarmState.ALARM_STATE_ACKNOWLEDGED
    assert (alarm.event, alarm.by, alarm.comment) == ("acknowledge", "Anna", "seen")
    assert alarm.text.startswith("T is ")
    assert [item.alarm for item in reply.alarms] == ["shewhart/T"]


@pytest.mark.parametrize(
    ("there", "state", "back"),
    [
        ("shelve", AlarmState.ALARM_STATE_SHELVED, "unshelve"),
        ("suppress", AlarmState.ALARM_STATE_SUPPRESSED_BY_DESIGN, "unsuppress"),
        ("take_out_of_service", AlarmState.ALARM_STATE_OUT_OF_SERVICE, "return_to_service"),
    ],
)
def test_an_alarm_goes_out_of_sight_and_comes_back(room: Room, there: str, state: AlarmState, back: str) -> None:
    shelve = ShelveAlarm(alarm="shewhart/T", by="Anna", minutes=30.0)
    reply = room.ask(there, shelve if there == "shelve" else by_anna())
    assert (reply.accepted, reply.alarms[0].state) == (True, state)
    assert reply.alarms[0].shelved_until_ns == (to_time_ns(END_MIN + 30) if there == "shelve" else 0)
    reply = room.ask(back, by_anna())
    assert (reply.accepted, reply.alarms[0].state) == (True, AlarmState.ALARM_STATE_UNACKNOWLEDGED)


def test_a_comment_changes_nothing_but_the_comment(room: Room) -> None:
    before = listed(room)["shewhart/T"]
    reply = room.ask("comment", by_anna(comment="valve is stiff"))
    assert (reply.alarms[0].state, reply.alarms[0].comment) == (before.state, "valve is stiff")
    assert [type(item.message) for item in room.published] == [Alarm]


def test_the_list_has_every_alarm_and_publishes_nothing(room: Room) -> None:
    reply = room.ask("list_alarms", ListAlarms())
    charts = ["shewhart/C", "shewhart/T", "ewma/C", "ewma/T", "mewma/all", "level/all"]
    assert [alarm.alarm for alarm in reply.alarms][:6] == charts
    assert {alarm.alarm.split("/")[0] for alarm in reply.alarms[6:]} == {"silence", "stuck", "range", "spike", "shift"}
    assert room.published == []


def test_one_command_acknowledges_every_alarm_of_an_incident(room: Room) -> None:
    before = listed(room)
    raised = [alarm.alarm for alarm in before.values() if alarm.incident == 1]
    assert len(raised) >= 3
    reply = room.ask("acknowledge", AlarmCommand(incident=1, by="Anna", comment="a leak"))
    assert reply.text == f"incident 1: acknowledge by Anna, {len(raised)} alarms"
    assert [alarm.alarm for alarm in reply.alarms] == raised
    after = listed(room)
    assert {after[name].state for name in raised} == {AlarmState.ALARM_STATE_ACKNOWLEDGED}
    assert {(after[name].by, after[name].comment) for name in raised} == {("Anna", "a leak")}
    assert all(after[name].state == before[name].state for name in after.keys() - set(raised))


def test_an_incident_is_published_as_single_acknowledgements_of_its_alarms(room: Room, alarmed: bytes) -> None:
    """So a recording of it is replayed from the alarms alone."""
    room.ask("acknowledge", AlarmCommand(incident=1, by="Anna"))
    names = [item.message.alarm for item in room.published if isinstance(item.message, Alarm)]
    singly = Room(CONFIG, alarmed)
    published = []
    for name in names:
        singly.ask("acknowledge", by_anna(name))
        published += singly.published
    assert room.published == published


def test_an_alarm_that_is_acknowledged_is_left_out_of_its_incident(room: Room) -> None:
    room.ask("acknowledge", by_anna("shewhart/T"))
    reply = room.ask("acknowledge", AlarmCommand(incident=1, by="Ben"))
    assert reply.accepted
    assert "shewhart/T" not in {alarm.alarm for alarm in reply.alarms}
    assert listed(room)["shewhart/T"].by == "Anna"
    again = room.ask("acknowledge", AlarmCommand(incident=1, by="Ben"))
    assert again.text == "incident 1 has no alarm to acknowledge (the latest incident is 1)"


def test_a_suspect_is_named_in_words(room: Room) -> None:
    (leak, *_) = listed(room)["shewhart/T"].suspects
    assert leak.cause == "coolant_flow"
    assert leak.text == "10 % of the coolant lost"


REFUSED: list[tuple[str, Message, str]] = [
    ("acknowledge", by_anna("shewhart/pH"), "there is no alarm 'shewhart/pH' (there are: shewhart/C, shewhart/T, "),
    ("acknowledge", AlarmCommand(alarm="shewhart/T"), "by must name the person, in 1 to 64 characters, got ''"),
    ("acknowledge", AlarmCommand(alarm="shewhart/T", by="   "), "by must name the person, in 1 to 64"),
    ("acknowledge", AlarmCommand(incident=2, by="Anna"), "incident 2 has no alarm to acknowledge (the latest incident"),
    ("acknowledge", AlarmCommand(alarm="ewma/T", incident=1, by="Anna"), "name an alarm or an incident, not both; got"),
    ("suppress", AlarmCommand(incident=1, by="Anna"), "an incident can be acknowledged and nothing else, got suppress"),
    ("unshelve", by_anna(), "alarm shewhart/T is not shelved"),
    ("return_to_service", by_anna(), "alarm shewhart/T is in service"),
    ("comment", by_anna(comment="  "), "comment must say something, got ''"),
    ("comment", by_anna(comment="x" * 1001), "comment must have at most 1000 characters, got 1001"),
    ("shelve", ShelveAlarm(alarm="shewhart/T", by="Anna"), "minutes must be in (0, 480], which longest_shelf_min"),
    ("shelve", ShelveAlarm(alarm="shewhart/T", by="Anna", minutes=481), "minutes must be in (0, 480]"),
    ("shelve", ShelveAlarm(alarm="shewhart/T", by="Anna", minutes=float("nan")), "minutes must be in (0, 480]"),
    ("shelve", by_anna(), "command shelve must carry 'application/protobuf;reactorwatch.v1.ShelveAlarm', got"),
    ("delete", by_anna(), "unknown command 'delete' (valid: acknowledge, unshelve, "),
]


@pytest.mark.parametrize(("name", "message", "text"), REFUSED, ids=[f"{n}: {t[:30]}" for n, _, t in REFUSED])
def test_what_cannot_be_done_is_refused_in_one_line_and_changes_nothing(
    room: Room, name: str, message: Message, text: str
) -> None:
    before = room.node.monitor(PLANT).alarms.memory.to_bytes()
    reply = room.ask(name, message)
    assert not reply.accepted
    assert reply.text.startswith(text)
    assert "\n" not in reply.text
    assert room.published == []
    assert room.node.monitor(PLANT).alarms.memory.to_bytes() == before
    (health,) = room.node.on_tick(1)
    assert isinstance(health.message, Health)
    assert health.message.refused == 1


def test_a_flood_of_commands_is_refused_counted_and_written_nowhere(
    tmp_path: Path, alarmed: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three thousand at once: as many writes to the disk as commands that are obeyed, and the next second is served."""
    room = Room(replace(CONFIG, state_file=str(tmp_path / "monitor.state")), alarmed)
    stored: list[int] = []
    monkeypatch.setattr("os.fsync", stored.append)
    replies = [room.ask("comment", by_anna(comment=f"number {number}")) for number in range(3000)]
    obeyed = [reply for reply in replies if reply.accepted]
    assert len(stored) == len(obeyed) == PER_NAME.at_once
    assert {reply.text for reply in replies if not reply.accepted} == {
        "too many commands by 'Anna': 30 at once and 5 a second are taken; try again in a second"
    }
    assert room.node.monitor(PLANT).intake.rejects.by_reason == {"too_many_commands": 3000 - len(obeyed)}
    assert room.ask("comment", AlarmCommand(alarm="shewhart/T", by="Ben", comment="mine")).accepted
    question = Encoded(f"reactor/{PLANT}/command/comment", *encode_message(by_anna(comment="a second later")))
    reply, _ = room.node.on_command(question, 1_000_000_000)
    assert reply is not None
    assert reply.accepted


def test_before_the_first_sample_nothing_can_be_acknowledged() -> None:
    reply = Room(CONFIG).ask("acknowledge", by_anna())
    assert not reply.accepted
    assert reply.text.startswith("no sample has come yet")


def test_the_plant_and_the_monitor_share_no_command() -> None:
    assert not set(COMMANDS) & set(PLANT_COMMANDS)


SECOND = 1_000_000_000


def count_obeyed(rate: CommandRateLimiter, names: list[str], now_ns: int = 0) -> int:
    """Number of the commands that are obeyed."""
    return sum(rate.check(name, now_ns) is None for name in names)


@pytest.mark.parametrize(
    ("names", "at_once"),
    [(["Anna"] * 3000, PER_NAME.at_once), ([str(n) for n in range(3000)], ALL.at_once), ([""] * 3000, ALL.at_once)],
    ids=["one name", "made-up names", "questions"],
)
def test_of_a_flood_as_many_are_taken_as_may_come_at_once(names: list[str], at_once: float) -> None:
    assert count_obeyed(CommandRateLimiter(), names) == at_once


def test_over_a_minute_the_rate_is_taken() -> None:
    rate = CommandRateLimiter()
    obeyed = sum(count_obeyed(rate, ["Anna"] * 50, second * SECOND) for second in range(60))
    assert obeyed == PER_NAME.at_once + 59 * PER_NAME.per_s


def test_one_person_s_flood_does_not_refuse_another_s_command() -> None:
    rate = CommandRateLimiter()
    assert count_obeyed(rate, ["Anna"] * 3000) == PER_NAME.at_once
    assert count_obeyed(rate, ["Ben"]) == 1


def test_questions_do_not_refuse_commands() -> None:
    rate = CommandRateLimiter()
    count_obeyed(rate, [""] * 3000)
    assert count_obeyed(rate, ["Ben"]) == 1


def test_a_clock_that_is_set_back_fills_no_bucket_and_ends_the_refusals() -> None:
    rate = CommandRateLimiter()
    count_obeyed(rate, ["Anna"] * 3000, 1000 * SECOND)
    assert count_obeyed(rate, ["Anna"], 0) == 0
    assert count_obeyed(rate, ["Anna"], SECOND) == 1


def test_made_up_names_take_no_memory() -> None:
    rate = CommandRateLimiter()
    for number in range(3 * MAX_NAMES):
        rate.check(str(number), number * SECOND)
    assert len(rate._names) == MAX_NAMES


def test_the_sender_is_the_name_in_the_command() -> None:
    assert sender_name(Encoded("k", *encode_message(AlarmCommand(alarm="x", by=" Anna ")))) == "Anna"
    assert sender_name(Encoded("k", *encode_message(ListAlarms()))) == ""
    assert sender_name(Encoded("k", b"?", "text/plain")) == ""
