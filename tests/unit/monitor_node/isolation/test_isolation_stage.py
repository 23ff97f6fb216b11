"""The schedule of looks, the rows they keep, and resuming within an incident."""

from typing import Any, cast

import msgspec
import pytest

from monitor_node.alarms.alarms import SuspectedCause
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.process_reference import ProcessReference
from monitor_node.config import MonitorConfig
from monitor_node.isolation import stage
from monitor_node.isolation.candidate import CandidateState, ProgressState
from monitor_node.isolation.isolation import Isolation
from monitor_node.isolation.stage import LOOKS, ROWS_BEFORE, Suspicion
from monitor_node.isolation.window import Row
from reactorwatch.contract.codec import Publication
from reactorwatch.process.library.cstr.model import cstr

from ..faulty import SENSORS, rows_of

CONFIG = MonitorConfig()
ALARM = 612
"""Index of the first row with an alarm, 1.2 min after the onset."""

UNITS = ["mol/l", "K"]


class Board:
    """Annunciator with one alarm without a known cause while `has_unexplained` is set; keeps the published causes."""

    def __init__(self) -> None:
        self.has_unexplained, self.incident = False, 1
        self.causes: list[list[SuspectedCause]] = []
        self.stopped: list[bool] = []

    def set_suspects(self, _: int, causes: list[SuspectedCause], *, stopped: bool = False) -> list[Publication]:
        self.causes.append(causes)
        self.stopped.append(stopped)
        return []


class Reference:
    """Reference with the model and the noise of the plant."""

    equations, plant_noise = cstr(), SENSORS


def suspicion() -> tuple[Suspicion, Board]:
    board = Board()
    return Suspicion(CONFIG, cast(Annunciator, board), cast(ProcessReference, Reference())), board


def feed(search: Suspicion, rows: list[Row]) -> None:
    for time_min, flow, values in rows:
        search.update(round(time_min * 60e9), flow, list(values), UNITS, [False, False])


def kept_rows(search: Suspicion) -> int:
    return len(search.state.rows) // (8 * 4)


@pytest.fixture(scope="module")
def leak() -> list[Row]:
    return rows_of("coolant_flow:step:-0.04", seed=3, after_min=140.0)


def test_looks_follow_until_their_last_and_rows_are_kept_as_long(leak: list[Row], monkeypatch: Any) -> None:
    looks: list[tuple[int, int, float]] = []

    def suspects(_: Isolation, rows: list[Row], since_rows: int) -> list[Any]:
        looks.append((len(rows), since_rows, rows[-1][0]))
        return original(_, rows[:30], since_rows)

    original = Isolation.suspects
    monkeypatch.setattr(Isolation, "suspects", suspects)
    search, board = suspicion()
    feed(search, leak[:ALARM])
    assert kept_rows(search) == CONFIG.isolation_rows
    board.has_unexplained = True
    feed(search, leak[ALARM : ALARM + LOOKS[-1] + 20])
    times = [leak[ALARM + since - 1][0] for since in LOOKS]
    assert [time_min for *_, time_min in looks] == pytest.approx(times)
    assert [rows for rows, *_ in looks] == [max(600, since + ROWS_BEFORE) for since in LOOKS]
    assert kept_rows(search) == CONFIG.isolation_rows  # after the last look
    board.incident += 1
    feed(search, leak[ALARM + LOOKS[-1] + 20 : ALARM + LOOKS[-1] + 40])
    assert len(looks) == len(LOOKS) + 1  # a new incident has looks of its own
    assert kept_rows(search) == CONFIG.isolation_rows + 19  # the first row of an incident is kept before its alarm
    board.has_unexplained = False
    feed(search, leak[ALARM + LOOKS[-1] + 40 : ALARM + LOOKS[-1] + 41])
    assert kept_rows(search) == CONFIG.isolation_rows


def test_late_looks_name_what_early_ones_cannot_and_a_resumed_search_says_the_same(leak: list[Row]) -> None:
    """A leak of 4 % is a large fault: looks resume from the progress of those before."""
    first, board = suspicion()
    feed(first, leak[:ALARM])
    board.has_unexplained = True
    feed(first, leak[ALARM : ALARM + 150])
    early = len(board.causes)
    state = msgspec.msgpack.decode(msgspec.msgpack.encode(first.state), type=stage.SuspicionState)
    assert state.way is not None
    second, other = suspicion()
    other.has_unexplained = True
    second.restore(state)
    assert second.state == state
    rest = leak[ALARM + 150 : ALARM + LOOKS[-2]]
    feed(first, rest)
    feed(second, rest)
    assert not any(board.stopped)
    assert other.causes == board.causes[early:]
    assert second.state == first.state
    assert [causes[0].cause for causes in board.causes[-1:]] == ["coolant_flow"]
    assert board.causes[-1][0].probability > 0.9


def test_a_look_is_taken_early_if_the_rows_contradict_the_last_one() -> None:
    """A leak that grows ends between the looks at 100 and at 300 rows; no filter of the bank follows it beyond."""
    rows = rows_of("coolant_flow:ramp:-0.05@60.03min,end=75min", seed=12, after_min=24.0)
    search, board = suspicion()
    feed(search, rows[:ALARM])
    board.has_unexplained = True
    feed(search, rows[ALARM : ALARM + 140])
    assert search.state.named_rows == 100
    feed(search, rows[ALARM + 140 : ALARM + 220])
    assert 140 < search.state.named_rows < 220
    assert (board.causes[-1][0].cause, board.causes[-1][0].profile) == ("coolant_flow", "ramp")
    assert board.causes[-1][0].probability > 0.5


def test_rows_far_apart_have_no_look_that_could_not_use_all_rows_since_the_alarm(monkeypatch: Any) -> None:
    looks: list[int] = []

    def suspects(_: Isolation, rows: list[Row], since_rows: int) -> list[Any]:
        looks.append(since_rows)
        return original(_, rows[:30], since_rows)

    original = Isolation.suspects
    monkeypatch.setattr(Isolation, "suspects", suspects)
    search, board = suspicion()
    board.has_unexplained = True
    feed(search, [(2.0 * index, (100.0,), (0.1, 438.5)) for index in range(LOOKS[-1] + 1)])
    assert looks == list(LOOKS[:4])


@pytest.mark.parametrize(
    "way",
    [
        {"stood_out_min": 1.0, "onset_min": 1.0, "until_min": 1.0, "first": True, "fits": []},
        ProgressState(1.0, 1.0, 1, [CandidateState("no_such_cause", "step", [1.0, 1.0], 1.0)]),
        ProgressState(1.0, 1.0, 1, []),
    ],
)
def test_a_stored_progress_of_another_version_or_of_unknown_causes_is_ignored(way: object) -> None:
    search, _ = suspicion()
    search.restore(msgspec.structs.replace(search.state, way=msgspec.to_builtins(way), since=12, incident=1))
    assert search.state.way is None
    assert search.state.since == 12
