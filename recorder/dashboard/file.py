"""Dashboards as files (.rrd), with their layout in them."""

import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import rerun as rr

from reactorwatch.records.atomic import atomic_write
from recorder.columns.run import RunColumns
from recorder.dashboard.read_plots import read_time_plots
from recorder.dashboard.renderer import Renderer
from recorder.dashboard.stream import APPLICATION
from recorder.panels import PANELS
from recorder.panels.base import Panel, View

_PIPE_BYTES = 65_536

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

    def onto(drawing: Renderer) -> None:
        zero_ns = 0
        for segment in (run,) if isinstance(run, RunColumns) else run:
            drawing.draw(segment, panels)
            zero_ns = segment.zero_ns
        drawing.add(DIAGNOSIS, "grid", plots, zero_ns)

    _write(path, onto)


def write_views(views_by_tab: Mapping[str, Sequence[View]], path: Path, zero_ns: int) -> None:
    """Write a dashboard of given views.

    Args:
        views_by_tab: views by the title of their tab.
        path: the file; an existing one is replaced.
        zero_ns: time that minutes count from.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """

    def onto(drawing: Renderer) -> None:
        for title, views in views_by_tab.items():
            drawing.add(title, "grid", views, zero_ns)

    _write(path, onto)


def _write(path: Path, onto: Callable[[Renderer], None]) -> None:
    recording = rr.RecordingStream(APPLICATION)
    with atomic_write(path) as temporary, _pipe_to(temporary) as pipe:
        recording.save(pipe)
        try:
            drawing = Renderer(recording)
            onto(drawing)
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
                    shutil.copyfileobj(source, file, _PIPE_BYTES)
            except OSError as error:
                failed.append(error)
                while source.read(_PIPE_BYTES):  # so that the writer never blocks
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
