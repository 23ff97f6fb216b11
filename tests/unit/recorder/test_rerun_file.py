"""Dashboards: what is in the file is what was recorded, and the viewer can open it."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from reactorwatch.errors import InputError
from recorder.panels import PANELS
from recorder.panels.base import EventLog, Panel, PlanePlot, TimePlot
from recorder.rerun_file import _BATCH_ROWS, RUN_TIME, SAMPLE_TIME, viewer_program, write_rrd
from recorder.run import Measured, Run, read_run
from tests.unit.recorder import golden


@pytest.fixture(scope="module")
def run() -> Run:
    return read_run(golden.entries())


@pytest.fixture(scope="module")
def drawn(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
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
    return "/" + "/".join(part.replace(" ", "\\ ") for part in parts)


def test_every_series_reads_back_exactly_on_both_timelines(run: Run, drawn: Path) -> None:
    found = over_time(drawn)
    plots = [(panel, view) for panel in PANELS for view in panel.draw(run) if isinstance(view, TimePlot)]
    lines = [(panel.title, plot.title, series) for panel, plot in plots for series in plot.series]
    assert len(lines) == 15
    first_ns, _ = run.span_ns
    for panel_title, plot_title, series in lines:
        parts = found[entity(panel_title, plot_title, series.name)]
        assert np.array_equal(numbers(parts), series.value, equal_nan=True)
        assert np.array_equal(times(parts, SAMPLE_TIME), series.time_ns)
        assert np.array_equal(times(parts, RUN_TIME), series.time_ns - first_ns)


def test_the_log_reads_back(run: Run, drawn: Path) -> None:
    ((panel, log),) = ((panel, view) for panel in PANELS for view in panel.draw(run) if isinstance(view, EventLog))
    (chunk,) = over_time(drawn)[entity(panel.title, log.title)]
    assert chunk.column("TextLog:text").flatten().to_pylist() == [event.text for event in log.events]
    assert chunk.column("TextLog:level").flatten().to_pylist() == [event.kind for event in log.events]


def test_a_long_run_is_written_in_batches_and_is_whole(tmp_path: Path) -> None:
    rows = 2 * _BATCH_ROWS + 5
    measured = Measured(np.arange(rows, dtype=np.int64) * 10**9, np.random.default_rng(1).normal(size=rows))
    run = Run("cstr", {"T": "K"}, {"T": measured}, {}, {}, (), ())
    write_rrd(run, tmp_path / "run.rrd")
    parts = over_time(tmp_path / "run.rrd")[entity("Signals", "Temperature T", "measured")]
    assert np.array_equal(numbers(parts), measured.value)


def test_the_viewers_own_check_accepts_the_file(drawn: Path) -> None:
    done = subprocess.run([viewer_program(), "rrd", "verify", drawn], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "1 file verified without error" in done.stdout + done.stderr


def test_the_blueprint_in_it_has_a_view_for_every_description_and_shows_the_whole_run(run: Run, drawn: Path) -> None:
    settings: dict[str, list[Any]] = {}
    for _, chunk in chunks(drawn, "blueprints"):
        for name in (name for name in chunk.schema.names if ":" in name):  # the components, not the times
            settings.setdefault(name, []).extend(chunk.column(name).to_pylist())
    titles = [view.title for panel in PANELS for view in panel.draw(run)]
    assert sorted(name.split(",")[0] for (name,) in settings["ViewBlueprint:display_name"]) == sorted(titles)
    endless = {"start": None, "end": None}
    assert settings["TimeAxis:view_range"] == [[endless]] * 5
    assert settings["TimePanelBlueprint:timeline"] == [[RUN_TIME]]


def test_a_run_of_nothing_can_be_drawn(tmp_path: Path) -> None:
    write_rrd(read_run([]), tmp_path / "run.rrd")
    assert over_time(tmp_path / "run.rrd") == {}


def test_what_fails_leaves_nothing_behind(run: Run, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        write_rrd(run, tmp_path / "no" / "run.rrd")
    plane = next(view for panel in PANELS for view in panel.draw(run) if isinstance(view, PlanePlot))
    broken = plane._replace(paths=(plane.paths[0]._replace(y=plane.paths[0].y * np.inf),))
    panel = Panel("Broken", lambda _: (broken,))
    with pytest.raises(ValueError, match="an axis must hold finite values"):
        write_rrd(run, tmp_path / "run.rrd", (panel,))
    assert not list(tmp_path.iterdir())
