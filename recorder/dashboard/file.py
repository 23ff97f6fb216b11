"""Dashboards as files (.rrd), with their layout in them."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import rerun as rr

from reactorwatch.errors import InputError
from reactorwatch.records.atomic import replacing
from recorder.dashboard.drawing import Drawing
from recorder.dashboard.reading import read_time_plots
from recorder.dashboard.stream import APPLICATION
from recorder.panels import PANELS
from recorder.panels.base import Panel, View
from recorder.run import Run

_FOOTER, _FOOTER_WITHIN = b"RRF2FOOT", 64

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
    with replacing(path) as temporary:
        recording.save(temporary)
        try:
            drawing = Drawing(recording)
            onto(drawing)
            recording.send_blueprint(drawing.layout.blueprint())
        finally:
            with suppress(RuntimeError):  # its thread has ended, and so has the file: see below
                recording.flush()
            recording.disconnect()
        if not _is_complete(temporary):
            raise InputError(f"cannot write {path}: it could not be completed, for lack of room on the disk perhaps")


def _is_complete(path: Path) -> bool:
    """Whether a file of Rerun's ends as one does; Rerun writes in a thread, and only logs that it could not."""
    with path.open("rb") as file:
        file.seek(-min(path.stat().st_size, _FOOTER_WITHIN), os.SEEK_END)
        return _FOOTER in file.read()
