"""How a dashboard is laid out: a tab for each panel, and in it its views, open on the whole run.

Rerun's own default is to show the last minute around the cursor. What is remembered of a view does not grow with the
run.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar, assert_never
from uuid import NAMESPACE_URL, uuid5

import rerun as rr
import rerun.blueprint as rrb

from recorder.dashboard.plane import Frame
from recorder.dashboard.stream import APPLICATION, RUN_TIME, SAMPLE_TIME, path_of
from recorder.panels.base import Again, Arrangement, EventLog, PlanePlot, StateLines, TimePlot, View

_ENDLESS = rr.TimeRangeBoundary.infinite()
_WHOLE_RUN = rr.TimeRange(start=_ENDLESS, end=_ENDLESS)
_LANES_SHARE = 1.3
"""Of the height, that lanes take beside time plots."""


class _Placed(NamedTuple):
    path: str
    view: View


@dataclass
class _Tab:
    arranged: Arrangement
    views: dict[str, View] = field(default_factory=dict)  # by title


class Layout:
    """The tabs and the views in them, as they become known."""

    def __init__(self) -> None:
        self._tabs: dict[str, _Tab] = {}
        self._frames: dict[str, Frame] = {}
        self.changed = False
        """Whether there is something that the last blueprint does not show."""

    def note(self, tab: str, arranged: Arrangement, views: Sequence[View]) -> None:
        """Take note of the views that a tab has.

        Args:
            tab: its title.
            arranged: how they are.
            views: those of a stretch.
        """
        known = self._tabs.setdefault(tab, _Tab(arranged))
        for view in views:
            before = known.views.get(view.title)
            after = known.views[view.title] = _merged(before, view)
            self.changed |= before is None or _is_bare(before) != _is_bare(after)
            if isinstance(view, PlanePlot):
                self._note_plane(origin(tab, view), view)
        titles = [view.title for view in views]
        if known.views.keys() == set(titles) and list(known.views) != titles:
            known.views = {title: known.views[title] for title in titles}  # all are there: their order is known now
            self.changed = True

    def frame(self, path: str) -> Frame:
        """That of a plane."""
        return self._frames[path]

    def blueprint(self, *, live: bool = False) -> rrb.Blueprint:
        """The layout of what is known by now.

        Args:
            live: whether the run goes on: the cursor then follows it.
        """
        self.changed = False
        tabs = [self._container(title, tab) for title, tab in self._tabs.items() if any(self._placed(title, tab))]
        return rrb.Blueprint(
            _lasting(rrb.Tabs(*tabs, active_tab=0 if tabs else None), "tabs"),
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

    def _placed(self, title: str, tab: _Tab) -> Iterator[_Placed]:
        """The views of a tab that have something in them, and where they are drawn."""
        for view in tab.views.values():
            where, shown = title, view
            if isinstance(view, Again):
                other = self._tabs.get(view.panel)
                if other is None or view.title not in other.views:
                    continue
                where, shown = view.panel, other.views[view.title]
            if not _is_bare(shown):
                yield _Placed(origin(where, shown), shown)

    def _container(self, title: str, tab: _Tab) -> rrb.Container:
        placed = list(self._placed(title, tab))
        if tab.arranged == "beside":
            over_time = [item for item in placed if isinstance(item.view, TimePlot | StateLines)]
            rest = [item for item in placed if item not in over_time]
            columns = [self._column(title, number, items) for number, items in enumerate((over_time, rest)) if items]
            return _lasting(rrb.Horizontal(*columns, column_shares=[3, 2][: len(columns)], name=title), title)
        views = [_lasting(self._view(item), title, item.path) for item in placed]
        if tab.arranged == "grid" and len(placed) > 1:
            return _lasting(rrb.Grid(*views, grid_columns=2, name=title), title)
        return _lasting(rrb.Vertical(*views, row_shares=_shares(placed), name=title), title)

    def _column(self, title: str, number: int, placed: Sequence[_Placed]) -> rrb.Container:
        """One under the other, so that one moment is one vertical line."""
        views = [_lasting(self._view(item), title, item.path) for item in placed]
        return _lasting(rrb.Vertical(*views, row_shares=_shares(placed)), title, str(number))

    def _view(self, placed: _Placed) -> rrb.View:
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
            case Again():
                raise AssertionError("what is drawn again was looked up before")
            case _:
                assert_never(view)


def origin(tab: str, view: View) -> str:
    """Where a view is drawn; Rerun labels lanes with their whole paths, so these are short and without spaces."""
    return path_of(view.title.lower().replace(" ", "-")) if isinstance(view, StateLines) else path_of(tab, view.title)


_Part = TypeVar("_Part", rrb.Container, rrb.View)


def _lasting(part: _Part, *names: str) -> _Part:
    """A part of the layout, known by its names also in the next one: a viewer keeps what people did to it."""
    part.id = uuid5(NAMESPACE_URL, "/".join((APPLICATION, *names)))
    return part


def _shares(placed: Sequence[_Placed]) -> list[float]:
    return [_LANES_SHARE if isinstance(item.view, StateLines) else 1.0 for item in placed]


def _is_bare(view: View) -> bool:
    """Whether there is nothing to be seen in a view."""
    return (isinstance(view, StateLines) and not view.lines) or (isinstance(view, EventLog) and not view.events)


def _merged(known: View | None, view: View) -> View:
    """What is remembered of a view: no numbers, and of lines and events one, to tell that there are any."""
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
