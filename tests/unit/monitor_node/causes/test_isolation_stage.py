"""The schedule of looks, the rows they keep, and resuming within an incident."""

from typing import Any, cast

import pytest

from monitor_node.alarms.alarms import SuspectedCause
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.causes.isolation import Isolation
from monitor_node.causes.scan import Lead, Progress
from monitor_node.causes.stage import FEW_ROWS, LOOKS, ROWS_BEFORE, Suspicion, SuspicionMemory
from monitor_node.causes.window import Row
from monitor_node.config import MonitorConfig
from monitor_node.learn.references import PlantEquations
from reactorwatch.process.library.cstr import cstr
from reactorwatch.stored_state import copy_of

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

    def set_suspects(self, causes: list[SuspectedCause], *, stopped: bool = False) -> None:
        self.causes.append(causes)
        self.stopped.append(stopped)


class Reference:
    """Reference with the model and the noise of the plant."""

    equations, plant_noise = cstr(), SENSORS


def suspicion(memory: SuspicionMemory | None = None) -> tuple[Suspicion, Board]:
    board = Board()
    return Suspicion(CONFIG, cast(Annunciator, board), cast(PlantEquations, Reference()), memory), board


def feed(search: Suspicion, rows: list[Row]) -> None:
    for time_min, flow, values in rows:
        search.update(round(time_min * 60e9), flow, list(values), UNITS, [False, False])


def kept_rows(search: Suspicion) -> int:
    return len(search.memory.rows)


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
    assert len(looks) == len(LOOKS) + 2  # a new incident has looks of its own
    assert kept_rows(search) == CONFIG.isolation_rows + 19  # the first row of an incident is kept before its alarm
    board.has_unexplained = False
    feed(search, leak[ALARM + LOOKS[-1] + 40 : ALARM + LOOKS[-1] + 41])
    assert kept_rows(search) == CONFIG.isolation_rows


def test_late_looks_name_what_early_ones_cannot_and_a_resumed_search_gives_the_same_result(leak: list[Row]) -> None:
    """A leak of 4 % is a large fault: looks resume from the progress of those before."""
    first, board = suspicion()
    feed(first, leak[:ALARM])
    board.has_unexplained = True
    feed(first, leak[ALARM : ALARM + 150])
    early = len(board.causes)
    memory = copy_of(first.memory)
    assert memory.progress is not None
    assert memory == first.memory
    second, other = suspicion(memory)
    other.has_unexplained = True
    rest = leak[ALARM + 150 : ALARM + LOOKS[-2]]
    feed(first, rest)
    feed(second, rest)
    assert not any(board.stopped)
    assert other.causes == board.causes[early:]
    assert second.memory == first.memory
    assert [causes[0].cause for causes in board.causes[-1:]] == ["coolant_flow"]
    assert board.causes[-1][0].probability > 0.9


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
    assert looks == [since for since in LOOKS if since <= FEW_ROWS]


@pytest.mark.parametrize("leads", [[Lead("no_such_cause", "step", [2.0, 60.0], 1.0)], []])
def test_a_stored_progress_of_unknown_causes_is_ignored(leads: list[Lead], leak: list[Row]) -> None:
    """The progress spans the whole record, so that the next look would resume from it."""
    found = []
    for progress in (None, Progress(0.0, 1e9, 1, leads)):
        isolation = Isolation(cstr(), SENSORS)
        isolation.fitter.progress = progress
        found.append(isolation.suspects(leak[: ALARM + 40]))
    assert found[0] == found[1]
