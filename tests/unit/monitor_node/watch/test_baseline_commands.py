"""Baseline commands after a change of the plant: accept, relearn and restore."""

import numpy as np
import pytest

from monitor_node.config import ReferenceName
from monitor_node.core import Monitor
from reactorwatch.arrays import Array
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, Baseline, BaselineCommand, CommandReply
from tests.exchanger import PLANT, config_of, random_exchanger, simulate

from ..samples import feed_row

SECOND_NS, TRAINING, CHANGE, END = 10**9, 1000, 1100, 2600
KEY = keys.key(PLANT, keys.COMMAND, "baseline")


@pytest.fixture(scope="module")
def plant() -> tuple[Array, Array]:
    """A sound plant whose measurement is 3 K higher from a row on, for good."""
    rng = np.random.default_rng(7)
    flow, measured = simulate(random_exchanger(rng), END, rng)
    return flow, measured + 3.0 * (np.arange(END) >= CHANGE)


class Run:
    """A monitor on the rows of a plant, and what it published."""

    def __init__(self, plant: tuple[Array, Array], reference: ReferenceName = "black-box") -> None:
        self.rows = list(zip(plant[0].tolist(), plant[1].tolist(), strict=True))
        self.config = config_of(reference)
        self.monitor = Monitor(self.config, 0)
        self.published: list[Publication] = []
        self.next = 0

    def take_until(self, end: int) -> "Run":
        for k in range(self.next, end):
            self.published += feed_row(self.monitor, k, k * SECOND_NS, self.rows[k])
        self.next = max(end, self.next)
        return self

    def resume(self) -> None:
        """Go on with another monitor, from the stored state."""
        other = Monitor(self.config, 0)
        other.from_bytes(self.monitor.to_bytes())
        other.on_history_end()
        assert other.to_bytes() == self.monitor.to_bytes()
        self.monitor = other

    def ask(self, what: str, **fields: object) -> CommandReply:
        command = BaselineCommand(what=what, by="Anna", why="new pump", **fields)  # type: ignore[arg-type]
        return self.monitor.on_command(Encoded(KEY, *encode_message(command)), 0)[0]

    @property
    def changes(self) -> list[Baseline]:
        return [item.message for item in self.published if isinstance(item.message, Baseline)]

    def raised(self, since: int) -> list[str]:
        alarms = [item.message for item in self.published if isinstance(item.message, Alarm)]
        return [item.alarm for item in alarms if item.event == "raised" and item.time_ns >= since * SECOND_NS]


def test_relearn_trains_from_the_next_row_on_and_publishes_its_author_and_reason(plant: tuple[Array, Array]) -> None:
    run = Run(plant).take_until(CHANGE + 20)
    assert run.raised(CHANGE)
    assert run.ask("relearn").accepted
    run.take_until(CHANGE + 21)
    (change,) = run.changes
    assert (change.what, change.by, change.why, change.id) == ("relearn", "Anna", "new pump", 1)
    assert change.time_ns == (CHANGE + 20) * SECOND_NS
    assert run.monitor.phase == "training"
    run.take_until(CHANGE + 20 + TRAINING + 2)
    assert run.monitor.phase == "watching"
    run.take_until(END)
    assert run.raised(CHANGE + 21) == []


def test_accept_learns_from_the_rows_since_the_alarm_on(plant: tuple[Array, Array]) -> None:
    run = Run(plant, "arx").take_until(CHANGE + 12)
    assert run.ask("accept").accepted
    first = min(
        item.message.time_ns
        for item in run.published
        if isinstance(item.message, Alarm) and item.message.alarm == "shift/th" and item.message.event == "raised"
    )
    run.take_until(first // SECOND_NS + TRAINING)
    assert run.monitor.phase == "training"
    run.take_until(first // SECOND_NS + TRAINING + 1)
    assert run.monitor.phase == "watching"
    assert [item.what for item in run.changes] == ["accept"]


def test_restore_judges_by_what_was_learned_before_as_if_nothing_had_been_learned(plant: tuple[Array, Array]) -> None:
    """The change is taken back at the plant, too: so the first baseline holds, and shifted rows are alarms again."""
    flow, measured = plant
    run = Run((flow, measured)).take_until(CHANGE + 20)
    run.ask("relearn")
    run.take_until(CHANGE + 21)
    assert run.monitor.pipeline.reference == ""
    assert run.ask("restore").accepted
    run.rows[CHANGE + 21 :] = [(u, y - 3.0) for u, y in run.rows[CHANGE + 21 :]]
    run.take_until(CHANGE + 400)
    assert run.monitor.pipeline.reference == "black-box"
    assert [(item.what, item.id, item.restored) for item in run.changes] == [("relearn", 1, 0), ("restore", 2, 0)]
    assert run.raised(CHANGE + 60) == []
    run.rows[CHANGE + 400 :] = [(u, y + 3.0) for u, y in run.rows[CHANGE + 400 :]]
    run.take_until(CHANGE + 420)
    assert run.raised(CHANGE + 400)


@pytest.mark.parametrize("reference", ["arx", pytest.param("black-box", marks=pytest.mark.slow)])
def test_a_replay_and_a_resumed_monitor_do_the_same_bit_for_bit(
    plant: tuple[Array, Array], reference: ReferenceName
) -> None:
    commands = {CHANGE + 15: "accept", CHANGE + 40: "restore", CHANGE + 60: "relearn"}
    run = Run(plant, reference)
    for at, what in commands.items():
        run.take_until(at)
        assert run.ask(what).accepted
        run.take_until(at + 5)
        run.resume()
    run.take_until(CHANGE + 60 + TRAINING + 50)
    run.resume()
    assert run.ask("restore", id=1).text == "id must be one of 0, 2, got 1"
    assert run.ask("restore", id=0).accepted
    run.take_until(run.next + 30)
    replayed = Run(plant, reference)
    for change in run.changes:
        replayed.monitor.schedule(change)
    replayed.take_until(run.next)
    assert len(run.changes) == 4
    assert replayed.published == run.published


@pytest.mark.parametrize("what", ["accept", "relearn", "restore"])
def test_a_command_is_executed_by_a_monitor_that_resumes_before_the_next_row(
    plant: tuple[Array, Array], what: str
) -> None:
    runs = [Run(plant, "arx").take_until(CHANGE + 12) for _ in range(2)]
    for run, is_resumed in zip(runs, (False, True), strict=True):
        if what == "restore":
            assert run.ask("relearn").accepted
            run.take_until(CHANGE + 13)
        assert run.ask(what).accepted
        if is_resumed:
            run.resume()
        run.take_until(CHANGE + 20)
    assert runs[0].changes[-1].what == what
    assert runs[0].published == runs[1].published
    assert runs[0].monitor.to_bytes() == runs[1].monitor.to_bytes()


@pytest.mark.parametrize(
    ("row", "fields", "text"),
    [
        (0, {"what": "relearn"}, "no sample has come yet, so there is no baseline to change"),
        (1010, {"what": "forget"}, "what must be one of accept, relearn, restore and list, got 'forget'"),
        (1010, {"what": "accept"}, "no alarm is active, so there are no rows to accept; relearn learns from the next"),
        (1010, {"what": "restore"}, "there is no earlier baseline to restore: nothing was learned again so far"),
        (1010, {"what": "relearn", "by": ""}, "by must name the person, in 1 to 64 characters, got ''"),
        (1010, {"what": "relearn", "why": " "}, "why must say why the baseline changes, got ''"),
    ],
)
def test_a_wrong_command_gets_one_line_and_changes_nothing(
    plant: tuple[Array, Array], row: int, fields: dict[str, str], text: str
) -> None:
    run = Run(plant, "arx").take_until(row)
    before = run.monitor.to_bytes()
    command = BaselineCommand(by="Anna", why="new pump")
    for name, value in fields.items():
        setattr(command, name, value)
    reply, published = run.monitor.on_command(Encoded(KEY, *encode_message(command)), 0)
    assert not reply.accepted
    assert reply.text.startswith(text)
    assert published == []
    run.monitor.memory.received -= 1
    run.monitor.intake.rejects.by_reason.clear()
    assert run.monitor.to_bytes() == before


def test_the_list_has_what_can_be_restored_and_last_what_is_in_force(plant: tuple[Array, Array]) -> None:
    run = Run(plant, "arx").take_until(1010)
    run.ask("relearn")
    run.take_until(1011)
    listed = run.ask("list").baselines
    assert [(item.id, item.what, item.by) for item in listed] == [(0, "trained", "monitor"), (1, "relearn", "Anna")]
