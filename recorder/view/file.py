"""Dashboards as files (.rrd), with their layout in them, and the time plots of such a file.

The plots are read so that the drawing of a diagnosis is reused in the dashboard of its run.
"""

import os
import re
import shutil
import tempfile
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from reactorwatch.errors import InputError
from reactorwatch.records.write import atomic_write
from recorder.columns import RunColumns
from recorder.panels import PANELS
from recorder.panels.base import Colour, Panel, Series, TimePlot, View
from recorder.view.drawing import APPLICATION, SAMPLE_TIME, Renderer

DIAGNOSIS = "Diagnosis"
"""Title of the tab of a diagnosis."""


def write_rrd(
    run: RunColumns | Iterable[RunColumns],
    path: Path,
    panels: tuple[Panel, ...] = PANELS,
    diagnosis: Path | None = None,
) -> None:
    """Write the dashboard of a run.

    Args:
        run: the run; or its segments, of which one is in memory at a time.
        path: the file; an existing one is replaced.
        panels: panels to draw.
        diagnosis: dashboard file of a diagnosis of the run (`write_views`), which becomes a tab; None for no tab.

    Raises:
        InputError: the folder does not exist or cannot be written to, or the diagnosis cannot be read.
    """
    plots = read_time_plots(diagnosis) if diagnosis is not None else []
    zero_ns = 0
    with _drawing(path) as drawing:
        for segment in (run,) if isinstance(run, RunColumns) else run:
            drawing.draw(segment, panels)
            zero_ns = segment.zero_ns
        drawing.add(DIAGNOSIS, "grid", plots, zero_ns)


def write_views(views_by_tab: Mapping[str, Sequence[View]], path: Path, zero_ns: int) -> None:
    """Write a dashboard of given views.

    Args:
        views_by_tab: views by the title of their tab.
        path: the file; an existing one is replaced.
        zero_ns: time that minutes count from.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    with _drawing(path) as drawing:
        for title, views in views_by_tab.items():
            drawing.add(title, "grid", views, zero_ns)


@contextmanager
def _drawing(path: Path) -> Iterator[Renderer]:
    """Renderer onto a file, which ends with its layout."""
    recording = rr.RecordingStream(APPLICATION)
    with atomic_write(path) as temporary, _pipe_to(temporary) as pipe:
        recording.save(pipe)
        try:
            drawing = Renderer(recording)
            yield drawing
            recording.send_blueprint(drawing.layout.blueprint())
        finally:
            recording.flush()
            recording.disconnect()


@contextmanager
def _pipe_to(path: Path) -> Iterator[Path]:
    """Pipe whose content is copied to a file.

    Rerun writes a file in a thread of its own. On a full disk it logs the error and continues, or blocks forever. With
    a pipe, the error is raised here.

    Raises:
        OSError: the file cannot be written.
    """
    failed: list[OSError] = []

    def copy() -> None:
        with pipe.open("rb", buffering=0) as source:
            try:
                with path.open("wb") as file:
                    shutil.copyfileobj(source, file)
            except OSError as error:
                failed.append(error)
                while source.read(65_536):  # so that the writer never blocks
                    pass

    with tempfile.TemporaryDirectory() as folder:
        pipe = Path(folder) / path.name
        os.mkfifo(pipe)
        thread = threading.Thread(target=copy, name="dashboard")
        thread.start()
        try:
            yield pipe
        finally:
            with suppress(OSError):  # the reader has ended
                os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))
            thread.join()
    if failed:
        raise failed[0]


_HELD = rr.components.InterpolationMode.StepAfter.value


def read_time_plots(path: Path) -> list[TimePlot]:
    """Time plots of a dashboard in the order of the layout, with units in their titles.

    Raises:
        InputError: the file does not exist or is no Rerun file.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    try:
        reader = RrdReader(path)
        titles = _titles(list(_chunks(reader, reader.blueprints())))
        lines = _lines(_chunks(reader, reader.recordings()))
    except (RuntimeError, ValueError, IndexError) as error:
        raise InputError(f"{path}: is no dashboard: {error}") from error
    return [
        TimePlot(title, "", tuple(line.series(name) for (origin, name), line in lines.items() if origin == wanted))
        for wanted, title in titles.items()
    ]


@dataclass
class _Line:
    """Data of a line, from the chunks of its entity."""

    style: dict[str, Any] = field(default_factory=dict)
    times: list[NDArray[np.int64]] = field(default_factory=list)
    values: list[NDArray[np.float64]] = field(default_factory=list)

    def series(self, name: str) -> Series:
        time_ns = np.concatenate(self.times or [np.empty(0, np.int64)])
        value = np.concatenate(self.values or [np.empty(0)])
        order = np.argsort(time_ns, kind="stable")
        red, green, blue, _ = int(self.style.get("colors", 0xFFFFFFFF)).to_bytes(4, "big")
        legend = str(self.style.get("names", name))
        return Series(
            name,
            time_ns[order],
            value[order],
            Colour(red, green, blue),
            width=float(self.style.get("widths", 1.5)),
            held=self.style.get("interpolation_mode") == _HELD,
            legend="" if legend == name else legend,
        )


def _chunks(reader: Any, stores: list[Any]) -> Iterator[tuple[str, Any]]:
    """(entity, record batch) of the chunks of the first store."""
    for chunk in reader.stream(store=stores[0]).to_chunks():
        yield str(chunk.entity_path), chunk.to_record_batch()


def _titles(blueprint: list[tuple[str, Any]]) -> dict[str, str]:
    """Titles of the time plots by path, in the order of the containers."""
    views, contents = {}, []
    for entity, batch in blueprint:
        components = {name: batch.column(name)[-1].as_py() for name in batch.schema.names if ":" in name}
        if components.get("ViewBlueprint:class_identifier") == ["TimeSeries"]:
            views[entity] = (components["ViewBlueprint:space_origin"][0], components["ViewBlueprint:display_name"][0])
        contents += [f"/{item.lstrip('/')}" for item in components.get("ContainerBlueprint:contents") or []]
    return dict(views[item] for item in contents if item in views)


def _lines(recording: Iterator[tuple[str, Any]]) -> dict[tuple[str, str], _Line]:
    """Lines by path of their plot and name, sorted."""
    lines: dict[tuple[str, str], _Line] = {}
    for entity, batch in recording:
        origin, _, last = entity.rpartition("/")
        line = lines.setdefault((origin, re.sub(r"\\(.)", r"\1", last)), _Line())
        names = batch.schema.names
        if "Scalars:scalars" in names:
            line.times.append(batch.column(SAMPLE_TIME).cast("int64").to_numpy())
            line.values.append(batch.column("Scalars:scalars").flatten().to_numpy())
        for name in (name for name in names if name.startswith("SeriesLines:")):
            line.style[name.removeprefix("SeriesLines:")] = batch.column(name)[-1].as_py()[0]
    return dict(sorted(lines.items()))
