"""Sessions of a plant that was started, stopped and started again, as one folder of recordings."""

from pathlib import Path

import numpy as np
import pytest

from reactorwatch.cli.info import info_object, info_text
from reactorwatch.contract.codec import encode
from reactorwatch.records.record import Record
from recorder import RecordedMessage
from recorder.columns import read_run
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter
from recorder.tools.convert import export_csv, read_record
from recorder.tools.inspect import inspect, zero_ns_of
from recorder.tools.player import Player, filter_playable, samples_of

SECOND = 1_000_000_000
START_NS = 1_772_352_000 * SECOND
ROWS = 300
PACE = 60
"""Plant time over clock time: the plant's clock is ahead when a session ends."""


def write_session(folder: Path, number: int, clock_s: int) -> None:
    """A session that starts at the clock's time and runs faster than it."""
    time_min = np.arange(ROWS) / 10
    columns = {signal: number + np.arange(ROWS) / 1000 for signal in ("qc", "C", "T")}
    start_ns = START_NS + clock_s * SECOND
    with RecordingWriter(folder / f"session-{number}.mcap", {"plant": "cstr"}) as writer:
        for publication in samples_of(Record(time_min, columns, "session"), "cstr", start_ns):
            encoded, time_ns = encode(publication), publication.message.time_ns
            received_ns = start_ns + (time_ns - start_ns) // PACE
            writer.write(RecordedMessage(encoded.key, encoded.payload, encoded.encoding, received_ns, time_ns))


@pytest.fixture(params=[60, 40_000], ids=["the clock steps back", "the clock goes on"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    (tmp_path / "runs").mkdir()
    for number in range(3):
        write_session(tmp_path / "runs", number, number * request.param)
    return tmp_path / "runs"


def test_no_sample_is_missing_where_none_is(folder: Path) -> None:
    seen = inspect(folder)
    assert (seen.overview.lost, seen.overview.duplicated, seen.overview.gaps) == (0, 0, [])
    assert len(info_object(seen, folder)["runs"]) == 3
    assert info_object(seen, folder)["zero"] == "2026-03-01T08:00:00Z"
    text = info_text(seen, folder)
    assert "no sample is missing" in text
    assert "3 runs of cstr" in text


def test_a_record_has_every_row_in_its_run(folder: Path, tmp_path: Path) -> None:
    record = read_record(folder)
    assert record.rows == 3 * ROWS
    assert [run.rows for run in record.split_runs()] == [ROWS] * 3
    for number, run in enumerate(record.split_runs()):
        assert np.allclose(np.diff(run.time_min), 0.1)
        assert np.array_equal(run.columns["T"], number + np.arange(ROWS) / 1000)
    assert export_csv(folder, tmp_path / "runs.csv").rows == 3 * ROWS
    assert (tmp_path / "runs.csv").read_text().startswith("time_min,qc,C,T,run\n0.0,")


def test_minutes_count_from_the_first_row_of_the_first_run(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    write_session(tmp_path / "runs", 0, 0)
    write_session(tmp_path / "runs", 1, 60)
    back = tmp_path / "runs" / "session-1.mcap"
    assert zero_ns_of(Recording(tmp_path / "runs")) == START_NS
    assert read_record(tmp_path / "runs").zero_ns == START_NS
    assert read_record(back).zero_ns == START_NS + 60 * SECOND


def test_a_drawing_shows_one_run_after_the_other(folder: Path) -> None:
    shown = read_run(Recording(folder).messages()).samples["T"]
    assert shown.time_ns.size == 3 * ROWS
    assert (np.diff(shown.time_ns) > 0).all()
    assert (np.diff(shown.value) > 0).all()


def test_each_run_is_played_at_its_pace(folder: Path) -> None:
    player = Player(lambda: filter_playable(Recording(folder).messages()), 1.0)
    now_ns, moments = 0, []
    while not player.finished:
        now_ns = max(now_ns, player.next_tick_ns())
        moments += [now_ns] * (len(player.on_tick(now_ns)) // 3)
    steps = np.diff(moments)
    assert np.count_nonzero(steps == 6 * SECOND) >= 3 * (ROWS - 1)
    assert (steps >= 6 * SECOND).all()
