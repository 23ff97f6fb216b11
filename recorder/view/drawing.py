"""Draw the views of panels with Rerun, segment by segment, into a file or a running viewer, and lay them out.

Each panel is a tab with its views, initially on the full run: Rerun's default is the last minute around the cursor. The
stored data of a view do not grow with the run.

Every point is on two timelines: the time of the run, usually since its first sample, for people, and the sample time,
for comparison with other data.

Rerun lacks a plot of one quantity over another, so the axes of a plane are drawn as lines and labels. Each segment adds
a strip to the path, and the view shows all strips regardless of their time. The first segment sets the scale of the
page. A frame that has become too small is redrawn larger.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar, assert_never
from uuid import NAMESPACE_URL, uuid5

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from reactorwatch.axis import Axis, axis
from recorder.columns import RunColumns, Times, Values
from recorder.panels.base import (
    LIMIT,
    Arrangement,
    Box,
    EventLog,
    Panel,
    PlaneMark,
    PlanePath,
    PlanePlot,
    Series,
    StateLines,
    TimePlot,
    View,
    ViewReference,
)

APPLICATION = "reactorwatch"
RUN_TIME = "run time"
SAMPLE_TIME = "sample time"
BATCH_ROWS = 8192
"""Points of a line that are sent at once, which bounds the memory of a message to Rerun."""

_ENDLESS = rr.TimeRangeBoundary.infinite()
_WHOLE_RUN = rr.TimeRange(start=_ENDLESS, end=_ENDLESS)


def path_of(*parts: str) -> str:
    """Path of an entity, from names with any characters."""
    return rr.new_entity_path(list(parts))


def _origin(tab: str, view: View) -> str:
    """Path of a view; Rerun labels lanes with their full paths, so these are short and without spaces."""
    return path_of(view.title.lower().replace(" ", "-")) if isinstance(view, StateLines) else path_of(tab, view.title)


class _Frame(NamedTuple):
    """Axes of a plane, and the box that sets its scales."""

    box: Box
    x_axis: Axis
    y_axis: Axis

    def contains(self, shown: Box) -> bool:
        across = self.x_axis.lower <= shown.x_lower and shown.x_upper <= self.x_axis.upper
        return across and self.y_axis.lower <= shown.y_lower and shown.y_upper <= self.y_axis.upper

    def page(self, x: Values, y: Values) -> NDArray[np.float64]:
        """Coordinates on a page where the box is 400 by 300, shape (points, 2); the second one points down."""
        box = self.box
        across = (x - box.x_lower) / ((box.x_upper - box.x_lower) or 1.0)
        up = (y - box.y_lower) / ((box.y_upper - box.y_lower) or 1.0)
        return np.column_stack([400.0 * across, 300.0 * (1.0 - up)])

    def strips(self, line: PlanePath) -> list[NDArray[np.float64]]:
        """Parts of a path between its gaps, on the page."""
        there = np.isfinite(line.x) & np.isfinite(line.y)
        edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
        return [self.page(line.x[start:end], line.y[start:end]) for start, end in edges.reshape(-1, 2)]

    @property
    def edges(self) -> tuple[float, float, float, float]:
        """Left, right, top and bottom in page coordinates."""
        corners = self.page(
            np.array([self.x_axis.lower, self.x_axis.upper]), np.array([self.y_axis.lower, self.y_axis.upper])
        )
        (left, bottom), (right, top) = corners.tolist()
        return left, right, top, bottom

    @property
    def bounds(self) -> rrb.VisualBounds2D:
        """Visible range of the page, labels included."""
        left, right, top, bottom = self.edges
        width, height = right - left, bottom - top
        return rrb.VisualBounds2D(
            x_range=(left - 0.12 * width, right + 0.1 * width), y_range=(top - 0.18 * height, bottom + 0.22 * height)
        )


class _PlacedView(NamedTuple):
    """A view, and how Rerun shows it."""

    view: View
    shown: rrb.View


@dataclass
class _Tab:
    arranged: Arrangement
    views: dict[str, View] = field(default_factory=dict)  # by title


class Layout:
    """Tabs and their views, extended segment by segment."""

    def __init__(self) -> None:
        self._tabs: dict[str, _Tab] = {}
        self.frames: dict[str, _Frame] = {}
        """Frames of planes, by path."""
        self.changed = False
        """True if the last blueprint lacks something."""

    def update(self, tab: str, arranged: Arrangement, views: Sequence[View]) -> None:
        """Add the views of a segment to a tab, of which the title is given."""
        known = self._tabs.setdefault(tab, _Tab(arranged))
        for view in views:
            before = known.views.get(view.title)
            after = known.views[view.title] = _merge(before, view)
            self.changed |= before is None or _is_empty(before) != _is_empty(after)
            if isinstance(view, PlanePlot):
                self._update_frame(_origin(tab, view), view)
        titles = [view.title for view in views]
        if known.views.keys() == set(titles) and list(known.views) != titles:
            known.views = {title: known.views[title] for title in titles}  # complete: now their order is known
            self.changed = True

    def blueprint(self, *, live: bool = False) -> rrb.Blueprint:
        """Rerun blueprint of the present tabs; the cursor follows a live run."""
        self.changed = False
        placed = {title: list(self._place_views(title, tab)) for title, tab in self._tabs.items()}
        tabs = [_container(title, self._tabs[title].arranged, items) for title, items in placed.items() if items]
        return rrb.Blueprint(
            _with_stable_id(rrb.Tabs(*tabs, active_tab=0 if tabs else None), "tabs"),
            rrb.TimePanel(state="collapsed", timeline=RUN_TIME, play_state="following" if live else "paused"),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            auto_views=False,
        )

    def _update_frame(self, path: str, plane: PlanePlot) -> None:
        known, shown = self.frames.get(path), plane.shown
        if known is None or not known.contains(shown):
            axes = axis(shown.x_lower, shown.x_upper), axis(shown.y_lower, shown.y_upper)
            self.frames[path] = _Frame(plane.box if known is None else known.box, *axes)
            self.changed = True

    def _place_views(self, title: str, tab: _Tab) -> Iterator[_PlacedView]:
        """Yield the non-empty views of a tab."""
        for view in tab.views.values():
            where, shown = title, view
            if isinstance(view, ViewReference):
                other = self._tabs.get(view.panel)
                if other is None or view.title not in other.views:
                    continue
                where, shown = view.panel, other.views[view.title]
            if not _is_empty(shown):
                path = _origin(where, shown)
                yield _PlacedView(shown, _with_stable_id(self._rerun_view(path, shown), title, path))

    def _rerun_view(self, path: str, view: View) -> rrb.View:
        match view:
            case TimePlot():
                return rrb.TimeSeriesView(
                    origin=path,
                    name=f"{view.title}, {view.unit}" if view.unit else view.title,
                    axis_x=rrb.TimeAxis(view_range=_WHOLE_RUN),
                    axis_y=rrb.ScalarAxis(range=view.shown) if view.shown else None,
                    plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
                )
            case StateLines():
                whole_run = rrb.TimeAxis(view_range=_WHOLE_RUN)
                return rrb.StateTimelineView(origin=path, name=view.title, time_view=whole_run)
            case EventLog():
                columns = rrb.TextLogColumns(
                    timeline_columns=[rrb.encodings.TimelineColumn(RUN_TIME, visible=False)],
                    text_log_columns=["loglevel", "body"],
                )
                return rrb.TextLogView(origin=path, name=view.title, columns=columns)
            case PlanePlot():
                at_any_time = [
                    rrb.VisibleTimeRange(timeline, start=_ENDLESS, end=_ENDLESS) for timeline in (RUN_TIME, SAMPLE_TIME)
                ]
                bounds = self.frames[path].bounds
                return rrb.Spatial2DView(origin=path, name=view.title, visual_bounds=bounds, time_ranges=at_any_time)
            case ViewReference():
                raise AssertionError("references were resolved before")
            case _:
                assert_never(view)


def _container(title: str, arranged: Arrangement, placed: Sequence[_PlacedView]) -> rrb.Container:
    if arranged == "beside":
        over_time = [item for item in placed if isinstance(item.view, TimePlot | StateLines)]
        others = [item for item in placed if item not in over_time]
        columns = [_column(items, title, str(number)) for number, items in enumerate((over_time, others)) if items]
        # a grid and not a row: on a phone it puts the second column below the first
        return _with_stable_id(rrb.Grid(*columns, column_shares=[3, 2][: len(columns)], name=title), title)
    if arranged == "grid" and len(placed) > 1:
        return _with_stable_id(rrb.Grid(*(item.shown for item in placed), grid_columns=2, name=title), title)
    return _column(placed, title, name=title)


def _column(placed: Sequence[_PlacedView], *id_names: str, name: str | None = None) -> rrb.Container:
    """Views one below the other, so that one time is one vertical line."""
    shares = [1.3 if isinstance(item.view, StateLines) else 1.0 for item in placed]  # lanes have labels beside them
    return _with_stable_id(rrb.Vertical(*(item.shown for item in placed), row_shares=shares, name=name), *id_names)


_Part = TypeVar("_Part", rrb.Container, rrb.View)


def _with_stable_id(part: _Part, *names: str) -> _Part:
    """Set an id derived from names, so that a viewer keeps the changes of users in the next blueprint."""
    part.id = uuid5(NAMESPACE_URL, "/".join((APPLICATION, *names)))
    return part


def _is_empty(view: View) -> bool:
    """True if a view shows nothing."""
    return (isinstance(view, StateLines) and not view.lines) or (isinstance(view, EventLog) and not view.events)


def _merge(known: View | None, view: View) -> View:
    """Stored form of a view: without numbers, and with one line or event as a sign that there are any."""
    match view:
        case TimePlot():
            shown = view.shown
            if isinstance(known, TimePlot) and known.shown is not None:
                shown = known.shown if shown is None else (min(known.shown[0], shown[0]), max(known.shown[1], shown[1]))
            return view._replace(series=(), shown=shown)
        case EventLog():
            return view._replace(events=view.events[:1] or getattr(known, "events", ()))
        case StateLines():
            return view._replace(lines=view.lines[:1] or getattr(known, "lines", ()))
        case PlanePlot():
            return view._replace(paths=(), curves=(), marks=(), events=())
        case _:
            return view


class Renderer:
    """Draws views onto a Rerun stream."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._static_keys: dict[str, object] = {}  # of the static data that were logged last, by path
        self.layout = Layout()

    def draw(self, run: RunColumns, panels: Sequence[Panel]) -> None:
        """Draw a run, or its next segment."""
        for panel in panels:
            self.add(panel.title, panel.arranged, panel.draw(run), run.zero_ns)

    def add(self, tab: str, arranged: Arrangement, views: Sequence[View], zero_ns: int) -> None:
        """Draw the views of a tab, with minutes from `zero_ns`; data of a view with a known title are added to it."""
        self.layout.update(tab, arranged, views)
        for view in views:
            path = _origin(tab, view)
            match view:
                case TimePlot():
                    for series in view.series:
                        self._draw_series(path + path_of(series.name), series, zero_ns)
                case EventLog():
                    self._draw_log(path, view, zero_ns)
                case StateLines():
                    self._draw_states(path, view, zero_ns)
                case PlanePlot():
                    self._draw_plane(path, view, zero_ns)
                case ViewReference():
                    pass
                case _:
                    assert_never(view)

    def _log_static(self, path: str, key: object, data: rr.AsComponents) -> None:
        """Log static data, unless those logged last had an equal key."""
        if self._static_keys.get(path) != key:
            self._static_keys[path] = key
            self._recording.log(path, data, static=True)

    def _send(self, path: str, time_ns: Times, zero_ns: int, columns: rr.ComponentColumnList) -> None:
        """Send columns, a row for each time."""
        clocks = [
            rr.TimeColumn(RUN_TIME, duration=(time_ns - zero_ns).astype("timedelta64[ns]")),
            rr.TimeColumn(SAMPLE_TIME, timestamp=time_ns.astype("datetime64[ns]")),
        ]
        self._recording.send_columns(path, clocks, columns, strict=True)

    def _draw_series(self, path: str, series: Series, zero_ns: int) -> None:
        mode = rr.components.InterpolationMode.StepAfter if series.held else rr.components.InterpolationMode.Linear
        style = rr.SeriesLines(
            colors=[series.colour],
            widths=[series.width],
            names=[series.legend or series.name],
            interpolation_mode=mode,
            # by default Rerun draws the average where several points fall on a pixel, and so hides every peak
            aggregation_policy=rr.components.AggregationPolicy.MinMax,
        )
        self._log_static(path, (series.colour, series.width, series.legend, series.held), style)
        for start in range(0, series.time_ns.size, BATCH_ROWS):
            rows = slice(start, start + BATCH_ROWS)
            self._send(path, series.time_ns[rows], zero_ns, rr.Scalars.columns(scalars=series.value[rows]))

    def _draw_log(self, path: str, log: EventLog, zero_ns: int) -> None:
        if not log.events:
            return
        columns = rr.TextLog.columns(
            text=[event.text for event in log.events],
            level=[event.kind for event in log.events],
            color=[event.colour for event in log.events],
        )
        self._send(path, np.array([event.time_ns for event in log.events], np.int64), zero_ns, columns)

    def _draw_states(self, path: str, lanes: StateLines, zero_ns: int) -> None:
        words, colours = list(lanes.colours), list(lanes.colours.values())
        for line in lanes.lines:
            lane = path + path_of(*line.name.split("/"))
            self._log_static(lane, tuple(words), rr.StateConfiguration(values=words, colors=colours))
            columns = rr.StateChange.columns(state=list(line.states))
            self._send(lane, np.array(line.time_ns, np.int64), zero_ns, columns)

    def _draw_plane(self, path: str, plane: PlanePlot, zero_ns: int) -> None:
        """Draw a plane, or add a segment to it: axes below, then paths, curves and marks."""
        frame = self.layout.frames[path]
        self._draw_axes(path, plane, frame)
        for order, line in enumerate(plane.paths):
            strips = frame.strips(line)
            if strips:
                where = path + path_of(line.name)
                style = rr.LineStrips2D.from_fields(
                    colors=[line.colour], radii=rr.Radius.ui_points(line.width / 2), draw_order=10.0 + order
                )
                self._log_static(where, (line.colour, line.width), style)
                columns = rr.LineStrips2D.columns(strips=strips).partition([len(strips)])
                self._send(where, np.array([plane.time_ns], np.int64), zero_ns, columns)
        for line in plane.curves:
            radius = rr.Radius.ui_points(line.width / 2)
            curve = rr.LineStrips2D(frame.strips(line), colors=[line.colour], radii=radius, draw_order=30.0)
            self._log_static(path + path_of(line.name), np.concatenate([line.x, line.y]).tobytes(), curve)
        if plane.marks:
            self._log_static(path + path_of("marks"), plane.marks, _points(plane.marks, frame))
        for mark in plane.events:
            self._log_static(path + path_of(mark.name), mark, _points((mark,), frame))

    def _draw_axes(self, path: str, plane: PlanePlot, frame: _Frame) -> None:
        x_axis, y_axis = frame.x_axis, frame.y_axis
        left, right, top, bottom = frame.edges
        width, height = right - left, bottom - top
        key = (x_axis.lower, x_axis.upper, y_axis.lower, y_axis.upper)
        x_ticks = frame.page(x_axis.ticks, np.full(x_axis.ticks.size, y_axis.lower))
        y_ticks = frame.page(np.full(y_axis.ticks.size, x_axis.lower), y_axis.ticks)
        lines = [[[at, top], [at, bottom]] for at, _ in x_ticks] + [[[left, at], [right, at]] for _, at in y_ticks]
        lines.append([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]])
        radius = rr.Radius.ui_points(0.4)
        grid = rr.LineStrips2D(lines, colors=[(90, 90, 90)], radii=radius, draw_order=0.0)
        self._log_static(path + path_of("axes"), key, grid)
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
            colors=[LIMIT],
            radii=rr.Radius.ui_points(0.0),
        )
        self._log_static(path + path_of("axis labels"), (key, plane.note), labels)


def _points(marks: Sequence[PlaneMark], frame: _Frame) -> rr.Points2D:
    return rr.Points2D(
        frame.page(np.array([mark.x for mark in marks]), np.array([mark.y for mark in marks])),
        labels=[mark.name for mark in marks],
        show_labels=True,
        colors=[mark.colour for mark in marks],
        radii=rr.Radius.ui_points(6.0),
        draw_order=100.0,
    )
