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
from recorder.columns.run import Run
from recorder.dashboard.drawing import Drawing
from recorder.dashboard.reading import read_time_plots
from recorder.dashboard.stream import APPLICATION
from recorder.panels import PANELS
from recorder.panels.base import Panel, View

_PIPE_BYTES = 65_536

DIAGNOSIS = "Diagnosis"
"""Title of the tab of a diagnosis."""


def write_rrd(
    run: Run | Iterable[Run], path: Path, panels: tuple[Panel, ...] = PANELS, diagnosis: Path | None = None
) -> None:
    """Draw a run.

    Args:
        run: the run; or its stretches, of which one is in memory at a time.
        path: the file; an older one of that name is replaced.
        panels: what is drawn of it.
        diagnosis: drawing of a diagnosis of the run (`write_views`), which becomes a tab; None: there is none.

    Raises:
        InputError: the folder does not exist or cannot be written to, or the drawing cannot be read.
    """
    plots = read_time_plots(diagnosis) if diagnosis is not None else []

    def onto(drawing: Drawing) -> None:
        zero_ns = 0
        for stretch in (run,) if isinstance(run, Run) else run:
            drawing.draw(stretch, panels)
            zero_ns = stretch.zero_ns
        drawing.add(DIAGNOSIS, "grid", plots, zero_ns)

    _write(path, onto)


def write_views(drawn: Mapping[str, Sequence[View]], path: Path, zero_ns: int) -> None:
    """Draw views of anything.

    Args:
        drawn: views, by the title of the tab that they are in.
        path: the file; an older one of that name is replaced.
        zero_ns: the time that the run counts from.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """

    def onto(drawing: Drawing) -> None:
        for title, views in drawn.items():
            drawing.add(title, "grid", views, zero_ns)

    _write(path, onto)


def _write(path: Path, onto: Callable[[Drawing], None]) -> None:
    recording = rr.RecordingStream(APPLICATION)
    with atomic_write(path) as temporary, _copied_to(temporary) as pipe:
        recording.save(pipe)
        try:
            drawing = Drawing(recording)
            onto(drawing)
            recording.send_blueprint(drawing.layout.blueprint())
        finally:
            recording.flush()
            recording.disconnect()


@contextmanager
def _copied_to(path: Path) -> Iterator[Path]:
    """A pipe whose content goes into a file.

    Rerun writes a file in a thread of its own; where the disk is full it logs that and goes on, or waits for ever. A
    pipe takes all, and the error is ours.

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
                while source.read(_PIPE_BYTES):  # so that the other end never waits
                    pass

    with tempfile.TemporaryDirectory() as folder:
        pipe = Path(folder) / path.name
        os.mkfifo(pipe)
        thread = threading.Thread(target=copy, name="dashboard")
        thread.start()
        try:
            yield pipe
        finally:
            with suppress(OSError):  # nobody reads any more
                os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))
            thread.join()
    if failed:
        raise failed[0]
