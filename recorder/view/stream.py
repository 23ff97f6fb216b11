"""Rerun stream with two timelines, which logs static data once, and plane plots on it.

Every point is on both timelines: the time of the run, usually since its first sample, for people, and the sample time,
for comparison with other data.

Rerun lacks a plot of one quantity over another, so its axes are drawn as lines and labels. Each segment adds a strip to
the path, and the view shows all strips regardless of their time. The first segment sets the scale of the page. A frame
that has become too small is redrawn larger.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from reactorwatch.axis import Axis, axis
from recorder.panels.base import Box, PlaneMark, PlanePath, PlanePlot

APPLICATION = "reactorwatch"
RUN_TIME = "run time"
SAMPLE_TIME = "sample time"
BATCH_ROWS = 8192


class Stream:
    """Rerun stream that logs static data once.

    Args:
        recording: the stream.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._static_keys: dict[str, object] = {}

    def log_static(self, path: str, key: object, data: rr.AsComponents) -> None:
        """Log static data, unless equal data were logged last.

        Args:
            path: path of the entity.
            key: key that is equal for equal data.
            data: the data.
        """
        if self._static_keys.get(path) != key:
            self._static_keys[path] = key
            self._recording.log(path, data, static=True)

    def send(self, path: str, time_ns: NDArray[np.int64], zero_ns: int, columns: rr.ComponentColumnList) -> None:
        """Send columns, a row for each time.

        Args:
            path: path of the entity.
            time_ns: sample times.
            zero_ns: time that minutes count from.
            columns: the values.
        """
        self._recording.send_columns(path, _clocks(time_ns, zero_ns), columns, strict=True)

    def send_series(self, path: str, time_ns: NDArray[np.int64], zero_ns: int, value: NDArray[np.float64]) -> None:
        """Send the points of a line, in batches."""
        for start in range(0, time_ns.size, BATCH_ROWS):
            rows = slice(start, start + BATCH_ROWS)
            self.send(path, time_ns[rows], zero_ns, rr.Scalars.columns(scalars=value[rows]))


def path_of(*parts: str) -> str:
    """Path of an entity, from names with any characters."""
    return rr.new_entity_path(list(parts))


def _clocks(time_ns: NDArray[np.int64], zero_ns: int) -> list[rr.TimeColumn]:
    return [
        rr.TimeColumn(RUN_TIME, duration=(time_ns - zero_ns).astype("timedelta64[ns]")),
        rr.TimeColumn(SAMPLE_TIME, timestamp=time_ns.astype("datetime64[ns]")),
    ]


_WIDTH, _HEIGHT = 400.0, 300.0  # page size of the box that sets the scales
_AXIS_COLOUR = (90, 90, 90)
_LABEL_COLOUR = (150, 150, 150)
_BELOW, _PATHS, _CURVES, _MARKS = 0.0, 10.0, 30.0, 100.0  # drawing order


class Frame(NamedTuple):
    """Axes of a plane, and the box that sets its scales."""

    box: Box
    x_axis: Axis
    y_axis: Axis

    @classmethod
    def around(cls, box: Box, shown: Box) -> "Frame":
        """Frame that contains `shown`."""
        return cls(box, axis(shown.x_lower, shown.x_upper), axis(shown.y_lower, shown.y_upper))

    def holds(self, shown: Box) -> bool:
        """True if the frame contains `shown`."""
        across = self.x_axis.lower <= shown.x_lower and shown.x_upper <= self.x_axis.upper
        return across and self.y_axis.lower <= shown.y_lower and shown.y_upper <= self.y_axis.upper

    def page(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Page coordinates, shape (points, 2); the second one points downwards, as on a screen."""
        box = self.box
        across = (x - box.x_lower) / ((box.x_upper - box.x_lower) or 1.0)
        up = (y - box.y_lower) / ((box.y_upper - box.y_lower) or 1.0)
        return np.column_stack([across * _WIDTH, (1.0 - up) * _HEIGHT])

    @property
    def edges(self) -> tuple[float, float, float, float]:
        """Left, right, top and bottom in page coordinates."""
        corners = self.page(
            np.array([self.x_axis.lower, self.x_axis.upper]), np.array([self.y_axis.lower, self.y_axis.upper])
        )
        (left, bottom), (right, top) = corners.tolist()
        return left, right, top, bottom

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Visible range of the page, labels included: (left, right), (top, bottom)."""
        left, right, top, bottom = self.edges
        width, height = right - left, bottom - top
        return (left - 0.12 * width, right + 0.1 * width), (top - 0.18 * height, bottom + 0.22 * height)


def draw_plane(stream: Stream, path: str, plane: PlanePlot, frame: Frame, zero_ns: int) -> None:
    """Draw a plane, or add a segment to it."""
    _draw_frame(stream, path, plane, frame)
    time_ns = np.array([plane.time_ns], np.int64)
    for order, line in enumerate(plane.paths):
        strips = _strips(line, frame)
        if strips:
            where = path + path_of(line.name)
            look = rr.LineStrips2D.from_fields(
                colors=[line.colour], radii=rr.Radius.ui_points(line.width / 2), draw_order=_PATHS + order
            )
            stream.log_static(where, (line.colour, line.width), look)
            columns = rr.LineStrips2D.columns(strips=strips).partition([len(strips)])
            stream.send(where, time_ns, zero_ns, columns)
    for line in plane.curves:
        curve = rr.LineStrips2D(
            _strips(line, frame), colors=[line.colour], radii=rr.Radius.ui_points(line.width / 2), draw_order=_CURVES
        )
        stream.log_static(path + path_of(line.name), np.concatenate([line.x, line.y]).tobytes(), curve)
    if plane.marks:
        stream.log_static(path + path_of("marks"), plane.marks, _points(plane.marks, frame))
    for mark in plane.events:
        stream.log_static(path + path_of(mark.name), mark, _points((mark,), frame))


def _draw_frame(stream: Stream, path: str, plane: PlanePlot, frame: Frame) -> None:
    x_axis, y_axis = frame.x_axis, frame.y_axis
    left, right, top, bottom = frame.edges
    width, height = right - left, bottom - top
    key = (x_axis.lower, x_axis.upper, y_axis.lower, y_axis.upper)
    x_ticks = frame.page(x_axis.ticks, np.full(x_axis.ticks.size, y_axis.lower))
    y_ticks = frame.page(np.full(y_axis.ticks.size, x_axis.lower), y_axis.ticks)
    grid = [[[at, top], [at, bottom]] for at, _ in x_ticks] + [[[left, at], [right, at]] for _, at in y_ticks]
    around = [[left, top], [right, top], [right, bottom], [left, bottom], [left, top]]
    lines = rr.LineStrips2D([*grid, around], colors=[_AXIS_COLOUR], radii=rr.Radius.ui_points(0.4), draw_order=_BELOW)
    stream.log_static(path + path_of("axes"), key, lines)
    texts = {
        **{(at, bottom + 0.05 * height): text for (at, _), text in zip(x_ticks, x_axis.labels, strict=True)},
        **{(left - 0.045 * width, at): text for (_, at), text in zip(y_ticks, y_axis.labels, strict=True)},
        ((left + right) / 2, bottom + 0.14 * height): plane.x_label,
        (left - 0.045 * width, top - 0.1 * height): plane.y_label,
    }
    if plane.note:
        texts[((left + right) / 2, top - 0.1 * height)] = plane.note
    labels = rr.Points2D(
        list(texts),
        labels=list(texts.values()),
        show_labels=True,
        colors=[_LABEL_COLOUR],
        radii=rr.Radius.ui_points(0.0),
    )
    stream.log_static(path + path_of("axis labels"), (key, plane.note), labels)


def _points(marks: Sequence[PlaneMark], frame: Frame) -> rr.Points2D:
    return rr.Points2D(
        frame.page(np.array([mark.x for mark in marks]), np.array([mark.y for mark in marks])),
        labels=[mark.name for mark in marks],
        show_labels=True,
        colors=[mark.colour for mark in marks],
        radii=rr.Radius.ui_points(6.0),
        draw_order=_MARKS,
    )


def _strips(line: PlanePath, frame: Frame) -> list[NDArray[np.float64]]:
    """Parts of a path between its gaps."""
    there = np.isfinite(line.x) & np.isfinite(line.y)
    edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
    return [frame.page(line.x[start:end], line.y[start:end]) for start, end in edges.reshape(-1, 2)]
