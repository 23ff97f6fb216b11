"""The live dashboard: the stream that a viewer receives, and what it shows of the run before it was opened."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.description.read import find_process
from reactorwatch.runtime.bus import Request
from recorder.columns import RunColumns, read_run
from recorder.view import live
from recorder.view.drawing import RUN_TIME, SAMPLE_TIME, Renderer
from recorder.view.live import (
    DRAW_INTERVAL_NS,
    ZERO_TIMEOUT_NS,
    HistoryQuery,
    LiveDashboard,
    RunHistory,
    alarm_changes,
    query_history,
)
from tests.memory_bus import Exchange, MemoryBus
from tests.unit.recorder import golden
from tests.unit.recorder.recording import MINUTE

MESSAGES = [Encoded(entry.key, entry.payload, entry.encoding) for entry in golden.entries()]


@pytest.fixture(scope="module")
def run() -> RunColumns:
    return read_run(MESSAGES)


def drawn_lines(path: Path) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """(time, value) of the lines, by entity."""
    reader = RrdReader(path)
    times: dict[str, list[NDArray[np.int64]]] = {}
    values: dict[str, list[NDArray[np.float64]]] = {}
    for chunk in reader.stream(store=reader.recordings()[0]).to_chunks():
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names:
            times.setdefault(str(chunk.entity_path), []).append(batch.column(SAMPLE_TIME).cast("int64").to_numpy())
            values.setdefault(str(chunk.entity_path), []).append(batch.column("Scalars:scalars").flatten().to_numpy())
    return {name: (np.concatenate(times[name]), np.concatenate(values[name])) for name in times}


@contextmanager
def dashboard_into(path: Path, *history: Any) -> Iterator[LiveDashboard]:
    """A live dashboard whose stream is a file."""
    recording = rr.RecordingStream("test")
    recording.save(path)
    yield LiveDashboard(recording, lambda: False, 0, *history)
    recording.flush()
    recording.disconnect()


@pytest.mark.parametrize("each_ns", [1_000_000, 40_000_000], ids=["many messages a picture", "few messages a picture"])
def test_all_of_a_run_is_sent_in_whatever_pieces_it_comes(run: RunColumns, tmp_path: Path, each_ns: int) -> None:
    with dashboard_into(tmp_path / "sent.rrd") as dashboard:
        now_ns = 0
        for message in MESSAGES:
            now_ns += each_ns
            while dashboard.next_tick_ns() < now_ns:
                dashboard.on_tick(dashboard.next_tick_ns())
            assert dashboard.on_message(message, now_ns) == []
        dashboard.on_stop(now_ns)
    sent = drawn_lines(tmp_path / "sent.rrd")
    for signal, measured in run.samples.items():
        (times, values), *others = (
            columns
            for path, columns in sent.items()
            if path.startswith(f"/Overview/{signal}\\:") and path.endswith("measured")
        )
        assert not others
        order = np.argsort(times)
        assert np.array_equal(times[order], measured.time_ns)
        assert np.array_equal(values[order], measured.value)


def test_it_draws_twice_a_second_and_not_message_by_message(monkeypatch: pytest.MonkeyPatch) -> None:
    drawings: list[RunColumns] = []
    monkeypatch.setattr(Renderer, "draw", lambda _self, run, _panels: drawings.append(run))
    dashboard = LiveDashboard(rr.RecordingStream("test"), lambda: False, 0)
    for number, message in enumerate(MESSAGES[:100]):
        dashboard.on_message(message, number)
    assert not drawings
    assert dashboard.next_tick_ns() == DRAW_INTERVAL_NS
    dashboard.on_tick(DRAW_INTERVAL_NS)
    dashboard.on_tick(2 * DRAW_INTERVAL_NS)
    (run,) = drawings  # what has nothing new is not drawn
    assert run.samples["T"].time_ns.size > 10
    assert dashboard.next_tick_ns() == 3 * DRAW_INTERVAL_NS


def test_the_layout_is_sent_when_there_is_something_new_and_not_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every layout that is sent is one that a viewer has to take over."""
    sent: list[int] = []
    number = 0
    monkeypatch.setattr(rr.RecordingStream, "send_blueprint", lambda *_: sent.append(number))
    dashboard = LiveDashboard(rr.RecordingStream("test"), lambda: False, 0)
    for number, message in enumerate(MESSAGES):
        dashboard.on_message(message, number * DRAW_INTERVAL_NS // 20)
    alarm = next(number for number, message in enumerate(MESSAGES) if "/alarm/" in message.key)
    assert sent[0] <= 20, "at once"
    assert any(alarm <= number <= alarm + 20 for number in sent), "the tab of the alarms"
    assert len(sent) < len(MESSAGES) / 20 / 4
    assert sent[-1] <= alarm + 500, "then there is nothing new"


def test_it_is_finished_when_the_viewer_is_closed() -> None:
    closed = [False]
    dashboard = LiveDashboard(rr.RecordingStream("test"), lambda: closed[0], 0)
    assert not dashboard.finished
    closed[0] = True
    assert dashboard.finished


def test_the_process_that_view_names_reaches_the_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    drawings: list[RunColumns] = []
    monkeypatch.setattr(Renderer, "draw", lambda _self, run, _panels: drawings.append(run))
    process = find_process("three_tanks")
    dashboard = LiveDashboard(rr.RecordingStream("test"), lambda: False, 0, process=process)
    dashboard.on_message(MESSAGES[0], 0)
    dashboard.on_tick(DRAW_INTERVAL_NS)
    dashboard.on_stop(DRAW_INTERVAL_NS)
    assert [run.process for run in drawings] == [process]


ZERO_NS = 1_700_000_000 * 10**9
NOW_NS = ZERO_NS + 500 * MINUTE
UNACKNOWLEDGED, ACKNOWLEDGED = messages.ALARM_STATE_UNACKNOWLEDGED, messages.ALARM_STATE_ACKNOWLEDGED
RETURNED, SHELVED = messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED, messages.ALARM_STATE_SHELVED
SUSPECT = messages.Suspect(cause="coolant_flow", probability=0.93, profile="step", size=-0.15, unit="1")
RAISED_MIN = {"ewma/T": 312.5, "cusum/T": 313.0, "mewma/all": 313.0, "shewhart/C": 315.5, "drift/C": 402.0}
STATES = dict(zip(RAISED_MIN, (UNACKNOWLEDGED, ACKNOWLEDGED, RETURNED, SHELVED, UNACKNOWLEDGED), strict=True))


def alarm(name: str) -> messages.Alarm:
    raised_ns = ZERO_NS + round(RAISED_MIN[name] * MINUTE)
    return messages.Alarm(
        time_ns=NOW_NS,
        alarm=name,
        state=STATES[name],
        raised_ns=raised_ns,
        cleared_ns=raised_ns + 10 * MINUTE if STATES[name] == RETURNED else 0,
        incident=2 if name == "drift/C" else 1,
        suspects=[] if name == "drift/C" else [SUSPECT],
        text=f"text of {name}",
    )


def as_raised(name: str) -> Encoded:
    """The message with which an alarm was raised, as its publisher sent it."""
    raised = alarm(name)
    raised.time_ns, raised.event = raised.raised_ns, "raised"
    return encode(Publication(f"reactor/cstr/alarm/{name}", raised))


LISTED = [*map(alarm, RAISED_MIN), messages.Alarm(alarm="stuck/T", state=messages.ALARM_STATE_NORMAL)]
HEALTH = messages.Health(node="monitor", heard_from_ns={"T": ZERO_NS + 1, "C": ZERO_NS})


class Remembering(MemoryBus):
    """A bus whose publishers remember the monitor's report."""

    def query_history(self, key_expression: str) -> list[Encoded]:
        assert key_expression == "reactor/cstr/health/**"
        return [encode(Publication("reactor/cstr/health/monitor", HEALTH))]


@pytest.fixture
def past(monkeypatch: pytest.MonkeyPatch) -> RunHistory:
    monkeypatch.setattr(live, "REPLY_TIMEOUT_S", 60.0)
    exchange = Exchange()

    def answer(request: Request) -> None:
        request.reply(messages.CommandReply(accepted=True, alarms=LISTED))

    MemoryBus(exchange).declare_queryable(keys.key("cstr", keys.COMMAND, "list_alarms"), answer)
    return query_history(Remembering(exchange), "cstr")


def logged(path: Path) -> list[tuple[float, str]]:
    """(minute on the run's time, text) of the lines in the log of alarms."""
    reader = RrdReader(path)
    found: list[tuple[float, str]] = []
    for chunk in reader.stream(store=reader.recordings()[0]).to_chunks():
        batch = chunk.to_record_batch()
        if "TextLog:text" in batch.schema.names:
            minutes = [time / MINUTE for time in batch.column(RUN_TIME).cast("int64").to_pylist()]
            found += zip(minutes, batch.column("TextLog:text").flatten().to_pylist(), strict=True)
    return sorted(found)


def shown(tmp_path: Path, past: RunHistory, received: list[Encoded]) -> list[tuple[float, str]]:
    with dashboard_into(tmp_path / "sent.rrd", past) as dashboard:
        for number, message in enumerate(received):
            dashboard.on_message(message, number)
        dashboard.on_tick(DRAW_INTERVAL_NS)
    return logged(tmp_path / "sent.rrd")


def sample(time_ns: int) -> Encoded:
    body = messages.Sample(time_ns=time_ns, value=440.0, unit="K", quality=messages.QUALITY_GOOD)
    return encode(Publication("reactor/cstr/sample/T", body))


@pytest.mark.parametrize("is_silent", [False, True])
def test_all_active_alarms_are_shown_with_their_suspects_at_their_minutes(
    tmp_path: Path, past: RunHistory, *, is_silent: bool
) -> None:
    """Also of a plant that sends no sample any more."""
    assert past.zero_ns == ZERO_NS
    lines = shown(tmp_path, past, [] if is_silent else [sample(NOW_NS)])
    for name, minute in RAISED_MIN.items():
        assert (minute, f"{minute:.1f} min  {name}: text of {name}") in lines
    assert sum("text of mewma/all" in text for _, text in lines) == 2  # raised and cleared
    assert [at for at, text in lines if "coolant_flow (93 %" in text] == [315.5]
    assert len(lines) == len(RAISED_MIN) + 2
    assert not any("stuck/T" in text for _, text in lines)


def test_a_change_that_publishers_remember_is_shown_once(tmp_path: Path, past: RunHistory) -> None:
    lines = shown(tmp_path, past, [sample(NOW_NS), as_raised("drift/C")])
    assert sum("drift/C" in text for _, text in lines) == 1


def test_the_present_state_of_each_is_the_last_that_is_known(past: RunHistory) -> None:
    last = {change.alarm: change.state for change in alarm_changes(LISTED)}
    assert last == STATES


def test_alarms_that_come_before_the_first_sample_are_not_lost(tmp_path: Path) -> None:
    """Of a plant without a monitor that could be asked."""
    with dashboard_into(tmp_path / "sent.rrd") as dashboard:
        dashboard.on_message(as_raised("ewma/T"), 0)
        dashboard.on_tick(DRAW_INTERVAL_NS)
        dashboard.on_message(sample(ZERO_NS), DRAW_INTERVAL_NS)
        dashboard.on_tick(2 * DRAW_INTERVAL_NS)
    assert [text for _, text in logged(tmp_path / "sent.rrd")] == ["312.5 min  ewma/T: text of ewma/T"]


def test_without_a_monitor_nothing_is_waited_for_and_nothing_is_known() -> None:
    assert query_history(MemoryBus(Exchange()), "cstr") == RunHistory()


class Answering:
    """What a plant's past is, answer by answer; the last one again and again."""

    def __init__(self, *answers: RunHistory) -> None:
        self._answers, self.asked, self.was_last = list(answers), 0, threading.Event()

    def __call__(self) -> RunHistory:
        self.asked += 1
        answer = self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]
        if len(self._answers) == 1 and answer.answered:
            self.was_last.set()
        return answer


MONITOR = keys.key("cstr", keys.ALIVE, "monitor")


def test_a_monitor_that_comes_later_answers_late_and_restarts_is_asked_until_it_answers(
    tmp_path: Path, past: RunHistory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each alarm is shown once, also those that came by themselves."""
    monkeypatch.setattr(live, "RETRY_S", 0.0)
    assert past.answered == {"monitor"}
    ask = Answering(RunHistory(), RunHistory(), past)
    query = HistoryQuery(ask)
    with dashboard_into(tmp_path / "sent.rrd", RunHistory(zero_ns=ZERO_NS), query) as dashboard:
        dashboard.on_message(sample(NOW_NS), 0)
        dashboard.on_message(as_raised("drift/C"), 0)
        for round_of in range(3):
            ask.was_last.clear()
            for token in (keys.key("cstr", keys.ALIVE, "plant"), keys.monitor_token("cstr", "x"), MONITOR):
                dashboard.on_alive(token, True, 0)
            assert ask.was_last.wait(60.0)
            if (thread := query._thread) is not None:
                thread.join(60.0)
            dashboard.on_alive(MONITOR, True, 0)  # as a token that is shown again; it has answered
            assert ask.asked == 3 + round_of
            dashboard.on_tick(DRAW_INTERVAL_NS * (1 + round_of))
            dashboard.on_alive(MONITOR, False, 0)
        dashboard.on_stop(DRAW_INTERVAL_NS * 10)
    lines = logged(tmp_path / "sent.rrd")
    assert [text.partition("  ")[2].partition(":")[0] for _, text in lines].count("drift/C") == 1
    assert len(lines) == len(RAISED_MIN) + 2


def test_a_monitor_that_never_answers_is_asked_no_more_once_the_view_ends() -> None:
    query = HistoryQuery(Answering(RunHistory()))
    query.on_alive(MONITOR, True)
    thread = query._thread
    assert thread is not None
    query.end()
    assert not thread.is_alive()


@pytest.mark.parametrize("reports", [True, False])
def test_the_minutes_of_a_fleet_s_plant_count_from_its_first_sample_once_its_monitor_reports(
    tmp_path: Path, past: RunHistory, *, reports: bool
) -> None:
    """Nothing is drawn before; without a report, they count from the first sample that came, after a while."""
    with dashboard_into(tmp_path / "sent.rrd", past._replace(zero_ns=None)) as dashboard:
        dashboard.on_message(sample(NOW_NS), 0)
        dashboard.on_tick(DRAW_INTERVAL_NS)
        if reports:
            dashboard.on_message(encode(Publication("reactor/cstr/health/monitor", HEALTH)), DRAW_INTERVAL_NS)
        dashboard.on_tick(2 * DRAW_INTERVAL_NS if reports else ZERO_TIMEOUT_NS)
    minutes = {text.partition("  ")[2].partition(":")[0]: minute for minute, text in logged(tmp_path / "sent.rrd")}
    assert minutes["drift/C"] == (402.0 if reports else 402.0 - 500.0)
