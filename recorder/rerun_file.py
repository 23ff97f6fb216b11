"""Dashboards as Rerun files; the only file that imports rerun.

It draws the descriptions that panels give, whatever they are of: a time plot by columns, in batches; a log; a plane,
whose axes are lines and labels, because Rerun has no plot of one value over another. Rerun's own default is to show
the last minute around the cursor; the blueprint in the file makes it open on the whole run.

Two timelines carry every point: the time since the first sample, for people, and the time of the sample, for those
who compare with something else.
"""

from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TypeAlias, assert_never

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.experimental import ViewerClient

from reactorwatch.axis import axis
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import replacing
from recorder.panels import PANELS
from recorder.panels.base import EventLog, Panel, PlanePath, PlanePlot, Series, TimePlot, View
from recorder.run import Run

RUN_TIME = "run time"
SAMPLE_TIME = "sample time"

_BATCH_ROWS = 8192
_WIDTH, _HEIGHT = 400.0, 300.0  # of a plane plot, in units of its own, in which every plane is as large
_AXIS_COLOUR = (70, 70, 70)
_LABEL_COLOUR = (190, 190, 190)
_WHOLE_RUN = rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())


def write_rrd(run: Run, path: Path, panels: tuple[Panel, ...] = PANELS) -> None:
    """Draw a run.

    Args:
        run: the run.
        path: the file; an older one of that name is replaced.
        panels: what is drawn of it.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    first_ns, _ = run.span_ns
    write_views({panel.title: panel.draw(run) for panel in panels}, path, f"{run.plant}-{first_ns}", first_ns)


def write_views(drawn: Mapping[str, Sequence[View]], path: Path, name: str, first_ns: int) -> None:
    """Draw views of anything.

    Args:
        drawn: views, by the title that they stand under.
        path: the file; an older one of that name is replaced.
        name: of the recording; one of the same name goes into the same window.
        first_ns: where the time of the run begins.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    recording = rr.RecordingStream("reactorwatch", recording_id=name)
    with replacing(path) as temporary:
        recording.save(temporary, default_blueprint=_blueprint(drawn))
        try:
            for title, views in drawn.items():
                for view in views:
                    _draw(recording, _path(title, view.title), view, first_ns)
        finally:
            recording.flush()
            recording.disconnect()


Viewer: TypeAlias = ViewerClient
"""A viewer that runs as a process of its own."""


def viewer_program() -> Path:
    """The viewer itself; the command `rerun` is a script that starts it, and does not end it when it is ended."""
    package = find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise InputError("no picture: this build of rerun comes without its viewer; install rerun-sdk from PyPI")
    return Path(package.origin).with_name("rerun")


def connect_viewer(port: int) -> Viewer:
    """A viewer that runs on this machine.

    Raises:
        ConnectionError: nothing listens at that port.
    """
    return ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")


def _path(*parts: str) -> str:
    return rr.new_entity_path(list(parts))


def _draw(recording: rr.RecordingStream, path: str, view: View, first_ns: int) -> None:
    match view:
        case TimePlot():
            for series in view.series:
                _draw_series(recording, f"{path}{_path(series.name)}", series, first_ns)
        case EventLog():
            _draw_log(recording, path, view, first_ns)
        case PlanePlot():
            _draw_plane(recording, path, view)
        case _:
            assert_never(view)


def _clocks(time_ns: NDArray[np.int64], first_ns: int) -> list[rr.TimeColumn]:
    return [
        rr.TimeColumn(RUN_TIME, duration=(time_ns - first_ns).astype("timedelta64[ns]")),
        rr.TimeColumn(SAMPLE_TIME, timestamp=time_ns.astype("datetime64[ns]")),
    ]


def _draw_series(recording: rr.RecordingStream, path: str, series: Series, first_ns: int) -> None:
    mode = rr.components.InterpolationMode.StepAfter if series.held else rr.components.InterpolationMode.Linear
    style = rr.SeriesLines(
        colors=[series.colour],
        widths=[series.width],
        names=[series.legend or series.name],
        interpolation_mode=mode,
        # by default Rerun draws the average where several points fall on a pixel, and so hides every peak
        aggregation_policy=rr.components.AggregationPolicy.MinMax,
    )
    recording.log(path, style, static=True)
    for start in range(0, series.time_ns.size, _BATCH_ROWS):
        rows = slice(start, start + _BATCH_ROWS)
        recording.send_columns(
            path, _clocks(series.time_ns[rows], first_ns), rr.Scalars.columns(scalars=series.value[rows]), strict=True
        )


def _draw_log(recording: rr.RecordingStream, path: str, log: EventLog, first_ns: int) -> None:
    if not log.events:
        return
    recording.send_columns(
        path,
        _clocks(np.array([event.time_ns for event in log.events], np.int64), first_ns),
        rr.TextLog.columns(
            text=[event.text for event in log.events],
            level=[event.kind for event in log.events],
            color=[event.colour for event in log.events],
        ),
        strict=True,
    )


def _draw_plane(recording: rr.RecordingStream, path: str, plane: PlanePlot) -> None:
    x = np.concatenate([line.x for line in plane.paths])
    y = np.concatenate([line.y for line in plane.paths])
    x_axis = axis(float(np.nanmin(x)), float(np.nanmax(x)))
    y_axis = axis(float(np.nanmin(y)), float(np.nanmax(y)))

    def page(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shape (points, 2); the second coordinate counts downwards, as on a screen."""
        return np.column_stack([x_axis.share(x) * _WIDTH, (1.0 - y_axis.share(y)) * _HEIGHT])

    def log(name: str, what: rr.AsComponents) -> None:
        recording.log(f"{path}{_path(name)}", what, static=True)

    x_ticks = page(x_axis.ticks, np.full(x_axis.ticks.size, y_axis.lower))
    y_ticks = page(np.full(y_axis.ticks.size, x_axis.lower), y_axis.ticks)
    grid = [[[at, 0.0], [at, _HEIGHT]] for at, _ in x_ticks] + [[[0.0, at], [_WIDTH, at]] for _, at in y_ticks]
    frame = [[0.0, 0.0], [_WIDTH, 0.0], [_WIDTH, _HEIGHT], [0.0, _HEIGHT], [0.0, 0.0]]
    log("axes", rr.LineStrips2D([*grid, frame], colors=[_AXIS_COLOUR], radii=rr.Radius.ui_points(0.4), draw_order=0))
    texts = [*x_axis.labels, *y_axis.labels, plane.x_label, plane.y_label]
    places = [
        *((at, _HEIGHT + 12.0) for at, _ in x_ticks),
        *((-18.0, at) for _, at in y_ticks),
        (_WIDTH / 2, _HEIGHT + 36.0),
        (-18.0, -28.0),
    ]
    log(
        "axis labels",
        rr.Points2D(places, labels=texts, show_labels=True, colors=[_LABEL_COLOUR], radii=rr.Radius.ui_points(0.0)),
    )
    for order, line in enumerate(plane.paths, start=1):
        strips = [page(line.x[rows], line.y[rows]) for rows in _unbroken(line)]
        log(
            line.name,
            rr.LineStrips2D(strips, colors=[line.colour], radii=rr.Radius.ui_points(0.6), draw_order=float(order)),
        )
    for mark in plane.marks:
        log(
            f"mark: {mark.name}",
            rr.Points2D(
                page(np.array([mark.x]), np.array([mark.y])),
                labels=[mark.name],
                show_labels=True,
                colors=[mark.colour],
                radii=rr.Radius.ui_points(5.0),
                draw_order=100.0,
            ),
        )


def _unbroken(line: PlanePath) -> Iterator[slice]:
    """The stretches of a path without gaps."""
    there = np.isfinite(line.x) & np.isfinite(line.y)
    edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
    return (slice(int(start), int(end)) for start, end in edges.reshape(-1, 2))


def _blueprint(drawn: Mapping[str, Sequence[View]]) -> rrb.Blueprint:
    over_time: list[rrb.View] = []
    beside: list[rrb.View] = []
    for title, views in drawn.items():
        for view in views:
            column = over_time if isinstance(view, TimePlot) else beside
            column.append(_view(_path(title, view.title), view))
    # time plots one under the other, so that one moment is one vertical line
    columns = [rrb.Vertical(*column) for column in (over_time, beside) if column]
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=[3, 2][: len(columns)]),
        rrb.TimePanel(state="collapsed", timeline=RUN_TIME, play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _view(path: str, view: View) -> rrb.View:
    match view:
        case TimePlot():
            return rrb.TimeSeriesView(
                origin=path,
                name=f"{view.title}, {view.unit}",
                axis_x=rrb.TimeAxis(view_range=_WHOLE_RUN),
                axis_y=rrb.ScalarAxis(range=view.shown) if view.shown else None,
                plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
            )
        case EventLog():
            return rrb.TextLogView(
                origin=path,
                name=view.title,
                columns=rrb.TextLogColumns(
                    timeline_columns=[rrb.encodings.TimelineColumn(RUN_TIME, visible=False)],
                    text_log_columns=["loglevel", "body"],
                ),
            )
        case PlanePlot():
            bounds = rrb.VisualBounds2D(x_range=[-50.0, _WIDTH + 20.0], y_range=[-40.0, _HEIGHT + 65.0])
            return rrb.Spatial2DView(origin=path, name=view.title, visual_bounds=bounds)
        case _:
            assert_never(view)
