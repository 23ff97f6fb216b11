"""Draw the views of panels with Rerun, segment by segment, into a file or a running viewer."""

from collections.abc import Sequence
from typing import assert_never

import numpy as np
import rerun as rr

from recorder.columns.run import RunColumns
from recorder.dashboard.layout import Layout, origin
from recorder.dashboard.plane import draw_plane
from recorder.dashboard.stream import Stream, path_of
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
