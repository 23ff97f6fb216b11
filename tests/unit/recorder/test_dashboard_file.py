"""Dashboards and recordings in Rerun: what is in the file is what was recorded, and the viewer can open it."""

import re
import subprocess
import weakref
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from reactorwatch.contract.codec import decode
from reactorwatch.contract.messages_pb2 import Alarm, Estimate, Fault, Health, Sample
from reactorwatch.errors import InputError
from recorder.columns import RunColumns, SampleColumns, read_run, read_segments
from recorder.files.writer import RecordingWriter
from recorder.panels import PANELS
from recorder.panels.base import (
    MEASURED,
    PREDICTED,
    EventLog,
    Panel,
    PlanePlot,
    Series,
    StateLines,
    TimePlot,
    View,
    ViewReference,
)
from recorder.view.drawing import BATCH_ROWS, RUN_TIME, SAMPLE_TIME
from recorder.view.file import read_time_plots, write_rrd, write_views
from recorder.view.viewer import viewer_program
from tests.unit.recorder import golden

V = TypeVar("V", bound=View)


@pytest.fixture(scope="module")
def run() -> RunColumns:
    return read_run(golden.entries())


@pytest.fixture(scope="module")
def drawn(run: RunColumns, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rrd") / "run.rrd"
    write_rrd(run, path)
    return path


Chunk: TypeAlias = Any  # a pyarrow.RecordBatch, which comes without types


def chunks(path: Path, store: str) -> Iterator[tuple[str, Chunk]]:
    """The chunks of one of the stores in a file, with the entity that each is of."""
    reader = RrdReader(path)
    for chunk in reader.stream(store=getattr(reader, store)()[0]).to_chunks():
        yield str(chunk.entity_path), chunk.to_record_batch()


def over_time(path: Path) -> dict[str, list[Chunk]]:
    """The chunks with a time, by entity, in order of time."""
    found: dict[str, list[Chunk]] = {}
    for entity_path, chunk in chunks(path, "recordings"):
        if RUN_TIME in chunk.schema.names:
            found.setdefault(entity_path, []).append(chunk)
    return {name: sorted(parts, key=lambda part: part.column(RUN_TIME)[0].value) for name, parts in found.items()}


def times(parts: list[Chunk], timeline: str) -> NDArray[np.int64]:
    return np.concatenate([part.column(timeline).cast("int64").to_numpy() for part in parts])


def numbers(parts: list[Chunk]) -> NDArray[np.float64]:
    """The scalars, one in each row."""
    return np.concatenate([part.column("Scalars:scalars").flatten().to_numpy() for part in parts])


def entity(*parts: str) -> str:
    return "/" + "/".join(re.sub(r"([^\w-])", r"\\\1", part) for part in parts)


def drawn_by(panel: str, run: RunColumns, kind: type[V]) -> list[V]:
    (found,) = (item for item in PANELS if item.title == panel)
    return [view for view in found.draw(run) if isinstance(view, kind)]


def test_every_series_reads_back_exactly_on_both_timelines(run: RunColumns, drawn: Path) -> None:
    found = over_time(drawn)
    plots = [(panel, view) for panel in PANELS for view in panel.draw(run) if isinstance(view, TimePlot)]
    lines = [(panel.title, plot.title, series) for panel, plot in plots for series in plot.series]
    assert {panel for panel, _, _ in lines} == {"Overview", "Residuals and charts", "Health"}
    first_ns, _ = run.span_ns
    for panel_title, plot_title, series in lines:
        parts = found[entity(panel_title, plot_title, series.name)]
        assert np.array_equal(numbers(parts), series.value, equal_nan=True)
        assert np.array_equal(times(parts, SAMPLE_TIME), series.time_ns)
        assert np.array_equal(times(parts, RUN_TIME), series.time_ns - first_ns)


def test_a_cut_keeps_the_minutes_of_the_run_it_is_of(run: RunColumns, tmp_path: Path) -> None:
    """Its first sample is at minute 140, say, on the timeline and in the log."""
    zero_ns = run.first_ns - 140 * 60_000_000_000
    write_rrd(read_segments(golden.entries(), 1000, zero_ns), tmp_path / "cut.rrd")
    found = over_time(tmp_path / "cut.rrd")
    measured = times(found[entity("Overview", "T: temperature of the reactor", "measured")], RUN_TIME)
    assert measured[0] == 140 * 60_000_000_000
    (text, *_) = [
        row
        for part in found[entity("Alarms", "Alarms and faults")]
        for row in part.column("TextLog:text").flatten().to_pylist()
    ]
    assert text.startswith("160.0 min  injected")
    lane = times(found[entity("alarm-states", "shewhart", "T")], SAMPLE_TIME)
    assert lane[0] >= run.first_ns, "nothing is drawn of before the cut"


def test_the_log_reads_back(run: RunColumns, drawn: Path) -> None:
    (log,) = drawn_by("Alarms", run, EventLog)
    (chunk,) = over_time(drawn)[entity("Alarms", log.title)]
    assert chunk.column("TextLog:text").flatten().to_pylist() == [event.text for event in log.events]
    assert chunk.column("TextLog:level").flatten().to_pylist() == [event.kind for event in log.events]


def test_the_states_of_alarms_and_nodes_read_back(run: RunColumns, drawn: Path) -> None:
    for panel, path in (("Alarms", ("alarm-states", "shewhart", "T")), ("Health", ("node-phases", "monitor"))):
        (lanes,) = drawn_by(panel, run, StateLines)
        parts = over_time(drawn)[entity(*path)]
        states = [state for part in parts for state in part.column("StateChange:state").flatten().to_pylist()]
        assert tuple(states) == lanes.lines[0].states
        assert tuple(times(parts, SAMPLE_TIME)) == lanes.lines[0].time_ns


def test_the_plane_holds_the_path_and_the_steady_states(run: RunColumns, drawn: Path) -> None:
    near, far = drawn_by("Phase plane", run, PlanePlot)
    found = over_time(drawn)
    for plane in (near, far):
        for path in plane.paths:
            parts = found[entity("Phase plane", plane.title, path.name)]
            points = np.array(
                [point for part in parts for strip in part.column("LineStrips2D:strips")[0].as_py() for point in strip]
            )
            assert len(points) == np.isfinite(path.x).sum()
            # on the page, to the right is more of C and down is less of T
            assert np.corrcoef(points[:, 0], path.x[np.isfinite(path.x)])[0, 1] == pytest.approx(1.0)
            assert np.corrcoef(points[:, 1], path.y[np.isfinite(path.y)])[0, 1] == pytest.approx(-1.0)
    labels = {
        path: chunk.column("Points2D:labels")[0].as_py()
        for path, chunk in chunks(drawn, "recordings")
        if "Points2D:labels" in chunk.schema.names
    }
    assert labels[entity("Phase plane", far.title, "marks")] == ["stable node", "saddle", "stable focus"]
    assert far.note in labels[entity("Phase plane", far.title, "axis labels")]


def everything(path: Path) -> dict[str, NDArray[np.float64]]:
    return {
        name: numbers(parts) for name, parts in over_time(path).items() if "Scalars:scalars" in parts[0].schema.names
    }


def test_stretch_by_stretch_the_same_is_drawn(drawn: Path, tmp_path: Path) -> None:
    write_rrd(read_segments(golden.entries(), 77), tmp_path / "run.rrd")
    whole, pieces = everything(drawn), everything(tmp_path / "run.rrd")
    assert whole.keys() == pieces.keys()
    for name, values in whole.items():
        if name.endswith(
            "statistic\\ out"
        ):  # what is out: where nothing is in a stretch, there are no gaps to be drawn
            beyond = [item[np.abs(item) > 3.0] for item in (values, pieces[name])]
            assert beyond[0].size
            assert np.array_equal(beyond[0], beyond[1])
        else:
            assert np.array_equal(values, pieces[name], equal_nan=True), name
    assert layout(tmp_path / "run.rrd")["ViewBlueprint:display_name"] == layout(drawn)["ViewBlueprint:display_name"]


def test_of_the_stretches_that_were_drawn_none_is_kept(tmp_path: Path) -> None:
    """So a recording larger than memory can be drawn; the last is there until the next has been read."""
    read: list[weakref.ref[RunColumns]] = []

    def watched() -> Iterator[RunColumns]:
        for stretch in read_segments(golden.entries(), 300):
            read.append(weakref.ref(stretch))
            yield stretch
            assert not [item for item in read[:-1] if item() is not None]

    write_rrd(watched(), tmp_path / "run.rrd")
    assert len(read) > 4


def test_a_long_run_is_written_in_batches_and_is_whole(tmp_path: Path) -> None:
    rows = 2 * BATCH_ROWS + 5
    measured = SampleColumns(np.arange(rows, dtype=np.int64) * 10**9, np.random.default_rng(1).normal(size=rows))
    run = RunColumns("cstr", {"T": "K"}, {"T": measured}, {}, {}, (), ())
    write_rrd(run, tmp_path / "run.rrd")
    parts = over_time(tmp_path / "run.rrd")[entity("Overview", "T: temperature of the reactor", "measured")]
    assert np.array_equal(numbers(parts), measured.value)


def test_the_viewers_own_check_accepts_the_file(drawn: Path) -> None:
    done = subprocess.run([viewer_program(), "rrd", "verify", drawn], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "1 file verified without error" in done.stdout + done.stderr


def layout(path: Path) -> dict[str, list[Any]]:
    """The settings in the blueprint of a file, by component, in the order of the entities."""
    settings: dict[str, list[Any]] = {}
    for _, chunk in sorted(chunks(path, "blueprints"), key=lambda item: item[0]):
        for name in (name for name in chunk.schema.names if ":" in name):  # the components, not the times
            settings.setdefault(name, []).extend(chunk.column(name).to_pylist())
    return settings


def test_it_opens_on_the_whole_run_with_a_tab_for_each_panel(run: RunColumns, drawn: Path) -> None:
    settings = layout(drawn)
    drawn_views = [(panel, view) for panel in PANELS for view in panel.draw(run)]
    shown = {view.title for _, view in drawn_views}
    named = [name for (name,) in settings["ViewBlueprint:display_name"]]
    assert {name.rsplit(",", 1)[0] for name in named} == shown
    assert len(named) == len(drawn_views)
    tabs = [name[0] for name in settings["ContainerBlueprint:display_name"] if name]
    assert sorted(tabs) == sorted(panel.title for panel in PANELS if panel.draw(run))
    over_time = [view for _, view in drawn_views if isinstance(view, TimePlot | StateLines)]
    again = [view for _, view in drawn_views if isinstance(view, ViewReference) and view.title == "Alarm states"]
    endless = {"start": None, "end": None}
    assert settings["TimeAxis:view_range"] == [[endless]] * (len(over_time) + len(again))
    assert settings["TimePanelBlueprint:timeline"] == [[RUN_TIME]]


def test_the_layout_of_the_same_views_is_the_same(drawn: Path, run: RunColumns, tmp_path: Path) -> None:
    """A live viewer that gets it again keeps what people did to its views."""
    write_rrd(run, tmp_path / "again.rrd")
    paths = [
        {path for path, _ in chunks(file, "blueprints") if path.startswith("/view")}
        for file in (drawn, tmp_path / "again.rrd")
    ]
    assert paths[0] == paths[1]


def test_a_diagnosis_becomes_a_tab_on_the_time_of_the_run(run: RunColumns, tmp_path: Path) -> None:
    time_ns = run.samples["T"].time_ns[100:110]
    size = Series("most likely", time_ns, np.linspace(0.0, -0.15, 10), PREDICTED, width=1.0, held=True, legend="size")
    other = Series("measured", time_ns, np.full(10, np.nan), MEASURED)
    views = [TimePlot("Zeal", "K", (size,)), TimePlot("Another/one", "", (size, other))]
    write_views({"Diagnosis": views}, tmp_path / "report.rrd", int(time_ns[0]))
    again = read_time_plots(tmp_path / "report.rrd")
    assert [plot.title for plot in again] == ["Zeal, K", "Another/one"]
    assert [series.name for series in again[1].series] == ["measured", "most likely"]
    (back,) = again[0].series
    assert back._replace(time_ns=time_ns, value=size.value) == size
    assert np.array_equal(back.time_ns, time_ns)
    assert np.array_equal(back.value, size.value)

    write_rrd(run, tmp_path / "run.rrd", diagnosis=tmp_path / "report.rrd")
    parts = over_time(tmp_path / "run.rrd")[entity("Diagnosis", "Zeal, K", "most likely")]
    assert np.array_equal(numbers(parts), size.value)
    assert np.array_equal(times(parts, RUN_TIME), time_ns - run.first_ns)
    assert ["Diagnosis"] in layout(tmp_path / "run.rrd")["ContainerBlueprint:display_name"]


@pytest.mark.parametrize(("content", "told"), [(None, "there is no such file"), (b"no dashboard", "is no dashboard")])
def test_a_file_that_is_no_drawing_of_a_diagnosis_is_reported(
    content: bytes | None, told: str, run: RunColumns, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / "report.rrd").write_bytes(content)
    with pytest.raises(InputError, match=told):
        write_rrd(run, tmp_path / "run.rrd", diagnosis=tmp_path / "report.rrd")


def test_a_run_of_nothing_can_be_drawn(tmp_path: Path) -> None:
    write_rrd(read_run([]), tmp_path / "run.rrd")
    assert over_time(tmp_path / "run.rrd") == {}


def test_what_fails_leaves_nothing_behind(run: RunColumns, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        write_rrd(run, tmp_path / "no" / "run.rrd")
    plane = drawn_by("Phase plane", run, PlanePlot)[0]
    broken = plane._replace(shown=plane.shown._replace(x_upper=np.inf))
    panel = Panel("Broken", lambda _: (broken,))
    with pytest.raises(ValueError, match="an axis must hold finite values"):
        write_rrd(run, tmp_path / "run.rrd", (panel,))
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def converted(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, list[Any]]:
    """The golden run as `rerun mcap convert` reads it: decoded messages by topic."""
    folder = tmp_path_factory.mktemp("interchange")
    with RecordingWriter(folder / "run.mcap", {}) as writer:
        for entry in golden.entries():
            writer.write(entry)
    convert = [str(viewer_program()), "mcap", "convert", str(folder / "run.mcap"), "-o", str(folder / "run.rrd")]
    subprocess.run(convert, check=True, capture_output=True)
    reader = RrdReader(folder / "run.rrd")
    found: dict[str, list[Any]] = {}
    for chunk in reader.stream(store=reader.recordings()[0]).to_chunks():
        batch = chunk.to_record_batch()
        for name in (name for name in batch.schema.names if name.endswith(":message")):
            found.setdefault(str(chunk.entity_path), []).extend(batch.column(name).flatten().to_pylist())
    return found


def test_rerun_decodes_every_message_of_every_topic(converted: Mapping[str, list[Any]]) -> None:
    expected: dict[str, int] = {}
    for entry in golden.entries():
        expected[f"/{entry.key}"] = expected.get(f"/{entry.key}", 0) + 1
    assert {topic: len(found) for topic, found in converted.items()} == expected


@pytest.mark.parametrize(
    ("key", "kind", "fields"),
    [
        ("sample/T", Sample, ("time_ns", "sequence", "value", "unit")),
        ("estimate/C", Estimate, ("time_ns", "prediction", "residual", "unit")),
        ("alarm/shewhart/T", Alarm, ("time_ns", "alarm", "value", "limit", "text")),
        ("fault/coolant_flow", Fault, ("specification", "active", "onset_ns")),
        ("health/monitor", Health, ("node", "phase")),
    ],
)
def test_rerun_reads_the_values_that_were_recorded(
    converted: Mapping[str, list[Any]], key: str, kind: type, fields: tuple[str, ...]
) -> None:
    ours = [decode(item.payload, item.encoding) for item in golden.entries() if item.key.endswith(key)]
    assert all(isinstance(item, kind) for item in ours)
    theirs = converted[f"/reactor/cstr/{key}"]
    assert [[item[name] for name in fields] for item in theirs] == [
        [getattr(item, name) for name in fields] for item in ours
    ]
