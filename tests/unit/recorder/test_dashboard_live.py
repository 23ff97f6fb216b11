"""The live dashboard: the stream that a viewer receives of an ongoing run, written into a file."""

from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from reactorwatch.contract.codec import Encoded
from reactorwatch.description.read import find_process
from recorder.columns import RunColumns, read_run
from recorder.view.drawing import SAMPLE_TIME, Renderer
from recorder.view.live import DRAW_INTERVAL_NS, LiveDashboard
from tests.unit.recorder import golden

MESSAGES = [Encoded(entry.key, entry.payload, entry.encoding) for entry in golden.entries()]


@pytest.fixture(scope="module")
def run() -> RunColumns:
    return read_run(MESSAGES)


def drawn(path: Path) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
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


@pytest.mark.parametrize("each_ns", [1_000_000, 40_000_000], ids=["many messages a picture", "few messages a picture"])
def test_all_of_a_run_is_sent_in_whatever_pieces_it_comes(run: RunColumns, tmp_path: Path, each_ns: int) -> None:
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "sent.rrd")
    dashboard = LiveDashboard(recording, lambda: False, 0)
    now_ns = 0
    for message in MESSAGES:
        now_ns += each_ns
        while dashboard.next_tick_ns() < now_ns:
            dashboard.on_tick(dashboard.next_tick_ns())
        assert dashboard.on_message(message, now_ns) == []
    dashboard.on_stop(now_ns)
    recording.flush()
    recording.disconnect()
    sent = drawn(tmp_path / "sent.rrd")
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
