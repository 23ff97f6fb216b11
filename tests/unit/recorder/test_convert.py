"""Import and export between records and recordings, also of a plant that was stopped and started again."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from reactorwatch.cli.info import info_object, info_text
from reactorwatch.errors import InputError
from reactorwatch.records.record import Record, join_runs
from reactorwatch.records.write import write_table
from recorder.columns import read_run
from recorder.files.recording import Recording
from recorder.tools.convert import export_csv, import_csv, read_record
from recorder.tools.inspect import inspect, zero_ns_of
from recorder.tools.player import Player, filter_playable, samples_of
from tests.tables import read_csv
from tests.unit.recorder.recording import SECOND, received, recorded
from tests.unit.records.test_csv_file import A_VALUE, assert_same


@given(
    steps=st.lists(st.integers(1, 10**9), min_size=1, max_size=30),
    start_us=st.integers(-(10**12), 10**12),
    values=arrays(np.float64, (3, 30), elements=A_VALUE),
    zero_ns=st.sampled_from([0, 1_700_000_000_123_456_789]),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
def test_import_and_then_export_give_the_identical_rows(
    tmp_path: Path, steps: list[int], start_us: int, values: np.ndarray, zero_ns: int
) -> None:
    """Times in whole microseconds, as decimal minutes or as seconds over 60, before and after zero."""
    columns = {signal: values[number, : len(steps)] for number, signal in enumerate(("qc", "C", "T"))}
    record = Record((start_us + np.cumsum(steps)) / 60e6, columns, "run.csv")
    assert_comes_back(tmp_path, record, zero_ns)


@given(
    rows=st.integers(2, 30),
    period_us=st.integers(1, 10**9),
    starts_us=st.lists(st.integers(-(10**12), 10**12), min_size=2, max_size=4),
    values=arrays(np.float64, (3, 30), elements=st.floats(-1e14, 1e14)),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=15)
def test_the_runs_of_a_record_come_back_identical(
    tmp_path: Path, rows: int, period_us: int, starts_us: list[int], values: np.ndarray
) -> None:
    """Each run starts anywhere: before the one before it, within it, or later."""
    columns = {signal: values[number, :rows] for number, signal in enumerate(("qc", "C", "T"))}
    times_us = period_us * np.arange(rows)
    record = join_runs([Record((start + times_us) / 60e6, columns, "run.csv") for start in starts_us])
    assert_comes_back(tmp_path, record, 0)


def assert_comes_back(tmp_path: Path, record: Record, zero_ns: int) -> None:
    """A record is the same after import and export, and the recording between them holds nothing but its rows."""
    write_table(tmp_path / "run.csv", record)
    assert import_csv(tmp_path / "run.csv", tmp_path / "run.mcap", "cstr", zero_ns=zero_ns).rows == record.rows
    assert export_csv(tmp_path / "run.mcap", tmp_path / "again.csv").rows == record.rows
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "run.csv").read_bytes()
    assert_same(read_record(tmp_path / "run.mcap"), read_csv(tmp_path / "run.csv"))
    entries = list(Recording(tmp_path / "run.mcap").messages())
    assert all(entry.publish_time_ns >= 0 for entry in entries)
    assert [entry.log_time_ns for entry in entries] == sorted(entry.log_time_ns for entry in entries)
    seen = inspect(tmp_path / "run.mcap")
    assert seen.overview.lost == seen.overview.duplicated == 0
    assert seen.overview.out_of_place == 0
    assert len(seen.overview.runs["cstr"]) == len(record.run_starts)


def test_an_imported_record_is_a_recording_received_when_it_was_measured(tmp_path: Path) -> None:
    csv, mcap = tmp_path / "run.csv", tmp_path / "run.mcap"
    csv.write_text("t,qc,C,T\n6,1,2,3\n12,4,5,6\n")
    import_csv(csv, mcap, "site", {"time_s": "t"}, zero_ns=1000)
    entries = list(Recording(mcap).messages())
    assert [entry.key.rsplit("/", 1)[1] for entry in entries] == ["qc", "C", "T"] * 2
    assert {entry.key.split("/")[1] for entry in entries} == {"site"}
    assert [entry.log_time_ns for entry in entries] == [6_000_001_000] * 3 + [12_000_001_000] * 3
    assert [entry.publish_time_ns for entry in entries] == [entry.log_time_ns for entry in entries]
    metadata = Recording(mcap).metadata
    assert (metadata["plant"], metadata["source"], metadata["zero_ns"]) == ("site", "run.csv", "1000")


def test_a_recording_of_negative_minutes_holds_shifted_times_and_their_zero_and_no_clock(tmp_path: Path) -> None:
    csv, mcap = tmp_path / "run.csv", tmp_path / "run.mcap"
    csv.write_text("time_min,qc,C,T\n-1500,1,2,3\n0,4,5,6\n")
    import_csv(csv, mcap, "cstr")
    assert Recording(mcap).metadata["zero_ns"] == str(2880 * 60 * 10**9)  # two days
    record = read_record(mcap)
    assert (record.time_min.tolist(), record.zero, record.zero_ns) == ([-1500.0, 0.0], None, 0)
    seen = info_object(inspect(mcap), mcap)
    assert (seen["from_min"], seen["to_min"], seen["zero"]) == (-1500.0, 0.0, None)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time_min,qc,C,T\n0,1,2,3\n1,x,2,3\n", "row 3, column 'qc'"),
        ("time_min,qc,C,T\n-1e12,1,2,3\n0,1,2,3\n", "expected a time within 146 years of its zero"),
        ("time_min,qc,C,T\n0,1,2,3\n1e12,1,2,3\n", "expected a time within 146 years of its zero"),
        ("time_s,qc,C,T\n0,1,2,3\n1e-9,1,2,3\n", "at least 1 microsecond apart to be recorded, got 0.0 and"),
    ],
)
def test_a_record_that_cannot_be_recorded_leaves_nothing_behind(tmp_path: Path, text: str, said: str) -> None:
    csv = tmp_path / "run.csv"
    csv.write_text(text)
    with pytest.raises(InputError, match=said):
        import_csv(csv, tmp_path / "run.mcap", "cstr")
    assert list(tmp_path.iterdir()) == [csv]


def test_a_bad_name_of_a_plant_leaves_nothing_behind(tmp_path: Path) -> None:
    csv = tmp_path / "run.csv"
    csv.write_text("time_min,qc,C,T\n0,1,2,3\n")
    with pytest.raises(InputError, match="plant name must be"):
        import_csv(csv, tmp_path / "run.mcap", "a/b")
    assert list(tmp_path.iterdir()) == [csv]


def test_an_older_recording_is_replaced(tmp_path: Path) -> None:
    csv, mcap = tmp_path / "run.csv", tmp_path / "run.mcap"
    csv.write_text("time_min,qc,C,T\n0,1,2,3\n")
    mcap.write_text("old")
    assert import_csv(csv, mcap, "cstr").rows == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.csv", "run.mcap"]


START_NS = 1_772_352_000 * SECOND
ROWS = 300
PACE = 60
"""Plant time over clock time: the plant's clock is ahead when a session ends."""


def write_session(folder: Path, number: int, clock_s: int) -> None:
    """A session that starts at the clock's time and runs faster than it."""
    time_min = np.arange(ROWS) / 10
    columns = {signal: number + np.arange(ROWS) / 1000 for signal in ("qc", "C", "T")}
    start_ns = START_NS + clock_s * SECOND
    samples = samples_of(Record(time_min, columns, "session"), "cstr", start_ns)
    entries = (received(key, body, start_ns + (body.time_ns - start_ns) // PACE) for key, body in samples)
    recorded(folder / f"session-{number}.mcap", entries, metadata={"plant": "cstr"})


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
