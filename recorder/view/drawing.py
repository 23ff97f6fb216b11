"""Draw the views of panels with Rerun, segment by segment, into a file or a running viewer, and lay them out.

Each panel is a tab with its views, initially on the full run: Rerun's default is the last minute around the cursor. The
stored data of a view do not grow with the run.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar, assert_never
from uuid import NAMESPACE_URL, uuid5

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from recorder.columns import RunColumns
from recorder.panels.base import (
    Arrangement,
    EventLog,
    Panel,
    PlanePlot,
    Series,
    StateLine,
    StateLines,
    TimePlot,
    View,
    ViewReference,
)
from recorder.view.stream import APPLICATION, RUN_TIME, SAMPLE_TIME, Frame, Stream, draw_plane, path_of

_ENDLESS = rr.TimeRangeBoundary.infinite()
_WHOLE_RUN = rr.TimeRange(start=_ENDLESS, end=_ENDLESS)
_LANES_SHARE = 1.3
"""Height of lanes, in heights of a time plot."""


class _PlacedView(NamedTuple):
    path: str
    view: View


@dataclass
class _Tab:
    arranged: Arrangement
    views: dict[str, View] = field(default_factory=dict)  # by title


class Layout:
    """Tabs and their views, extended segment by segment."""

    def __init__(self) -> None:
        self._tabs: dict[str, _Tab] = {}
        self._frames: dict[str, Frame] = {}
        self.changed = False
        """True if the last blueprint lacks something."""

    def update(self, tab: str, arranged: Arrangement, views: Sequence[View]) -> None:
        """Add the views of a segment to a tab.

        Args:
            tab: title of the tab.
            arranged: arrangement of the tab.
            views: the views.
        """
        known = self._tabs.setdefault(tab, _Tab(arranged))
        for view in views:
            before = known.views.get(view.title)
            after = known.views[view.title] = _merge(before, view)
            self.changed |= before is None or _is_empty(before) != _is_empty(after)
            if isinstance(view, PlanePlot):
                self._note_plane(origin(tab, view), view)
        titles = [view.title for view in views]
        if known.views.keys() == set(titles) and list(known.views) != titles:
            known.views = {title: known.views[title] for title in titles}  # complete: now their order is known
            self.changed = True

    def frame(self, path: str) -> Frame:
        """Frame of a plane."""
        return self._frames[path]

    def blueprint(self, *, live: bool = False) -> rrb.Blueprint:
        """Rerun blueprint of the present tabs.

        Args:
            live: True if the run continues: the cursor then follows it.
        """
        self.changed = False
        tabs = [self._container(title, tab) for title, tab in self._tabs.items() if any(self._place_views(title, tab))]
        return rrb.Blueprint(
            _with_stable_id(rrb.Tabs(*tabs, active_tab=0 if tabs else None), "tabs"),
            rrb.TimePanel(state="collapsed", timeline=RUN_TIME, play_state="following" if live else "paused"),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            auto_views=False,
        )

    def _note_plane(self, path: str, plane: PlanePlot) -> None:
        known = self._frames.get(path)
        if known is None or not known.holds(plane.shown):
            self._frames[path] = Frame.around(plane.box if known is None else known.box, plane.shown)
            self.changed = True

    def _place_views(self, title: str, tab: _Tab) -> Iterator[_PlacedView]:
        """Yield the non-empty views of a tab with their paths."""
        for view in tab.views.values():
            where, shown = title, view
            if isinstance(view, ViewReference):
                other = self._tabs.get(view.panel)
                if other is None or view.title not in other.views:
                    continue
                where, shown = view.panel, other.views[view.title]
            if not _is_empty(shown):
                yield _PlacedView(origin(where, shown), shown)

    def _container(self, title: str, tab: _Tab) -> rrb.Container:
        placed = list(self._place_views(title, tab))
        if tab.arranged == "beside":
            over_time = [item for item in placed if isinstance(item.view, TimePlot | StateLines)]
            rest = [item for item in placed if item not in over_time]
            columns = [self._column(title, number, items) for number, items in enumerate((over_time, rest)) if items]
            # a grid and not a row: on a phone it puts the second column below the first
            return _with_stable_id(rrb.Grid(*columns, column_shares=[3, 2][: len(columns)], name=title), title)
        views = [_with_stable_id(self._view(item), title, item.path) for item in placed]
        if tab.arranged == "grid" and len(placed) > 1:
            return _with_stable_id(rrb.Grid(*views, grid_columns=2, name=title), title)
        return _with_stable_id(rrb.Vertical(*views, row_shares=_shares(placed), name=title), title)

    def _column(self, title: str, number: int, placed: Sequence[_PlacedView]) -> rrb.Container:
        """Views one below the other, so that one time is one vertical line."""
        views = [_with_stable_id(self._view(item), title, item.path) for item in placed]
        return _with_stable_id(rrb.Vertical(*views, row_shares=_shares(placed)), title, str(number))

    def _view(self, placed: _PlacedView) -> rrb.View:
        path, view = placed
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
                across, down = self._frames[path].bounds
                at_any_time = [
                    rrb.VisibleTimeRange(timeline, start=_ENDLESS, end=_ENDLESS) for timeline in (RUN_TIME, SAMPLE_TIME)
                ]
                bounds = rrb.VisualBounds2D(x_range=across, y_range=down)
                return rrb.Spatial2DView(origin=path, name=view.title, visual_bounds=bounds, time_ranges=at_any_time)
            case ViewReference():
                raise AssertionError("references were resolved before")
            case _:
                assert_never(view)


def origin(tab: str, view: View) -> str:
    """Path of a view; Rerun labels lanes with their full paths, so these are short and without spaces."""
    return path_of(view.title.lower().replace(" ", "-")) if isinstance(view, StateLines) else path_of(tab, view.title)


_Part = TypeVar("_Part", rrb.Container, rrb.View)


def _with_stable_id(part: _Part, *names: str) -> _Part:
    """Set an id derived from names, so that a viewer keeps the changes of users in the next blueprint."""
    part.id = uuid5(NAMESPACE_URL, "/".join((APPLICATION, *names)))
    return part


def _shares(placed: Sequence[_PlacedView]) -> list[float]:
    return [_LANES_SHARE if isinstance(item.view, StateLines) else 1.0 for item in placed]


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
    """Draws views onto a Rerun stream.

    Args:
        recording: the stream.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._stream = Stream(recording)
        self.layout = Layout()

    def draw(self, run: RunColumns, panels: Sequence[Panel]) -> None:
        """Draw a run, or its next segment."""
        for panel in panels:
            self.add(panel.title, panel.arranged, panel.draw(run), run.zero_ns)

    def add(self, tab: str, arranged: Arrangement, views: Sequence[View], zero_ns: int) -> None:
        """Draw views.

        Args:
            tab: title of their tab.
            arranged: arrangement of the tab.
            views: the views; data of a view with a known title are added to it.
            zero_ns: time that minutes count from.
        """
        self.layout.update(tab, arranged, views)
        for view in views:
            path = origin(tab, view)
            match view:
                case TimePlot():
                    for series in view.series:
                        self._draw_series(path + path_of(series.name), series, zero_ns)
                case EventLog():
                    self._draw_log(path, view, zero_ns)
                case StateLines():
                    for line in view.lines:
                        self._draw_states(path + path_of(*line.name.split("/")), line, view, zero_ns)
                case PlanePlot():
                    draw_plane(self._stream, path, view, self.layout.frame(path), zero_ns)
                case ViewReference():
                    pass
                case _:
                    assert_never(view)

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
        self._stream.log_static(path, (series.colour, series.width, series.legend, series.held), style)
        self._stream.send_series(path, series.time_ns, zero_ns, series.value)

    def _draw_log(self, path: str, log: EventLog, zero_ns: int) -> None:
        if not log.events:
            return
        columns = rr.TextLog.columns(
            text=[event.text for event in log.events],
            level=[event.kind for event in log.events],
            color=[event.colour for event in log.events],
        )
        self._stream.send(path, np.array([event.time_ns for event in log.events], np.int64), zero_ns, columns)

    def _draw_states(self, path: str, line: StateLine, lanes: StateLines, zero_ns: int) -> None:
        words, colours = list(lanes.colours), list(lanes.colours.values())
        self._stream.log_static(path, tuple(words), rr.StateConfiguration(values=words, colors=colours))
        columns = rr.StateChange.columns(state=list(line.states))
        self._stream.send(path, np.array(line.time_ns, np.int64), zero_ns, columns)
