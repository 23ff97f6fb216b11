"""Figures of reports, notebooks and studies: panels of lines, bands and marks, each described once.

`panel_svg` writes a panel for a page. It needs no library, so every installation draws the curves of its reports; the
colours are variables of the page's style sheet, light or dark. `draw` draws the same panels with matplotlib, for
notebooks, print and studies. Why both: docs/decisions/0030-figures.md.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.axis import Axis, axis
from reactorwatch.optional import import_optional

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = {
    "measured": ("#9aa5b1", "#75808b"),
    "before": ("#d55e00", "#ff8a3d"),
    "after": ("#0072b2", "#56b4e9"),
    "input": ("#00805f", "#35c49c"),
    "other": ("#cc79a7", "#cc79a7"),
    "alarm": ("#b3261e", "#ff6b60"),
    "limit": ("#1c1f23", "#e6e9ec"),
    "expected": ("#d8dde3", "#3a4149"),
}
"""Colours by meaning on a light and on a dark ground, after Okabe & Ito (2008), Color Universal Design."""

WIDTH, HEIGHT = 900, 250
LEFT, RIGHT, TOP, BOTTOM = 64, 10, 8, 30
COLUMNS = 600
LABEL_ROOM = 40

GAP = 10.0
"""A line is interrupted where the time step exceeds this factor times the median step."""

PANEL_IN, DPI = (9.0, 1.9), 100
STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "lines.linewidth": 1.5,
    "legend.fontsize": 8.5,
    "legend.frameon": True,
    "legend.framealpha": 0.85,
    "legend.edgecolor": "none",
    "figure.facecolor": "white",
}


@dataclass(frozen=True, eq=False)
class Line:
    """A line of a panel.

    Attributes:
        label: text in the legend; empty: none.
        x: shape (points,), increasing.
        y: shape (points,); NaN: a gap.
        kind: key of `COLOURS`; a measured line is wide, a limit is dotted.
        steps: True if a value is held until the next one.
    """

    label: str
    x: Array
    y: Array
    kind: str = "measured"
    steps: bool = False

    @property
    def extent(self) -> tuple[Array, ...]:
        """Values that the vertical axis has to show."""
        return (self.y,)


@dataclass(frozen=True, eq=False)
class Band:
    """Area between two lines over `x`, each of shape (points,); `label` and `kind` as those of a line."""

    label: str
    x: Array
    lower: Array
    upper: Array
    kind: str = "expected"

    @property
    def extent(self) -> tuple[Array, ...]:
        """Values that the vertical axis has to show."""
        return self.lower, self.upper


@dataclass(frozen=True)
class Mark:
    """A moment, drawn as a vertical line, or a span, which is shaded.

    Attributes:
        x: the moment, or the start of the span.
        label: text in the legend of the first panel; empty: none.
        kind: key of `COLOURS`.
        end: end of the span; None: a moment.
    """

    x: float
    label: str = ""
    kind: str = "limit"
    end: float | None = None


@dataclass(frozen=True, eq=False)
class Panel:
    """One plot.

    Attributes:
        title: quantity and unit.
        items: lines and bands; bands are drawn below the lines.
        marks: moments and spans.
        x_title: unit of the horizontal axis.
        limits: lowest and highest value of the vertical axis; None: those of the data.
        text: description for readers that do not see it; empty: the title.
    """

    title: str
    items: tuple[Line | Band, ...]
    marks: tuple[Mark, ...] = ()
    x_title: str = "min"
    limits: tuple[float, float] | None = None
    text: str = field(default="", kw_only=True)

    @property
    def legend(self) -> tuple[tuple[str, str], ...]:
        """Label and class of each item that has a label: its kind, and `area` for a band or a span."""
        lines = [(item.label, item.kind + " area" * isinstance(item, Band)) for item in self.items]
        marks = [(mark.label, mark.kind + (" area" if mark.end is not None else " moment")) for mark in self.marks]
        return tuple(dict.fromkeys((label, kind) for label, kind in [*lines, *marks] if label))


@cache
def _figure_class() -> type["Figure"]:
    """A figure that shows itself once in a notebook, whichever backend is active."""
    base = import_optional("matplotlib.figure", "plot()").Figure

    class NotebookFigure(base):  # type: ignore[misc, valid-type] # known at run time only
        def _repr_png_(self) -> bytes:
            return figure_png(self)

    return NotebookFigure


@contextmanager
def plain_style() -> Iterator[None]:
    """Set matplotlib's style in full, whatever the user's matplotlibrc says, so that figures are the same bytes."""
    matplotlib = import_optional("matplotlib", "a figure")
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        yield


def draw(panels: Sequence[Panel]) -> "Figure":
    """Draw panels over one another with one horizontal axis.

    Args:
        panels: panels from the top.

    Raises:
        InputError: matplotlib is not installed.
    """
    width, height = PANEL_IN
    with plain_style():
        figure = _figure_class()(figsize=(width, 0.6 + height * len(panels)), layout="constrained")
        axes: Any = np.atleast_1d(figure.subplots(len(panels), sharex=True))
        for number, (axes_, panel) in enumerate(zip(axes, panels, strict=True)):
            _draw_panel(axes_, panel, mark_labels=number == 0)
        axes[-1].set_xlabel(panels[-1].x_title)
    return figure


def _draw_panel(axes: Any, panel: Panel, *, mark_labels: bool) -> None:
    for item in panel.items:
        colour = COLOURS[item.kind][0]
        if isinstance(item, Band):
            axes.fill_between(item.x, item.lower, item.upper, color=colour, alpha=0.3, label=item.label, linewidth=0)
        else:
            style: dict[str, Any] = {"linewidth": 2.4 if item.kind == "measured" else 0.9}
            style |= {"linestyle": ":"} if item.kind == "limit" else {}
            drawstyle = "steps-post" if item.steps else "default"
            axes.plot(item.x, item.y, color=colour, label=item.label, drawstyle=drawstyle, **style)
    for mark in panel.marks:
        label, colour = mark.label if mark_labels and mark.label else None, COLOURS[mark.kind][0]
        if mark.end is None:
            axes.axvline(mark.x, color=colour, linestyle="--", linewidth=1.0, label=label)
        else:
            axes.axvspan(mark.x, mark.end, color=colour, alpha=0.12, label=label, linewidth=0)
    if panel.limits is not None:
        axes.set_ylim(panel.limits)
    axes.set_ylabel(panel.title)
    if len(axes.get_legend_handles_labels()[0]) > 1:
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


def figure_png(figure: "Figure") -> bytes:
    """A figure as PNG, without date and version."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None})
    return file.getvalue()


def panel_svg(panel: Panel) -> str:
    """A panel as an `svg` element: small, without scripts, in the colours of the page's style sheet."""
    values = np.concatenate([values for item in panel.items for values in item.extent])
    finite = values[np.isfinite(values)]
    times = np.concatenate([item.x for item in panel.items])
    across = _Across(float(times.min()), float(times.max()))
    low, high = panel.limits or (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    up = axis(low, high, 4)
    area = f'x="{LEFT}" y="{TOP}" width="{WIDTH - LEFT - RIGHT}" height="{HEIGHT - TOP - BOTTOM}"'
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(panel.text or panel.title)}">',
        _grid(up),
        f'<svg {area} viewBox="{LEFT} {TOP} {WIDTH - LEFT - RIGHT} {HEIGHT - TOP - BOTTOM}">',  # cuts off
        *(_span(mark, across) for mark in panel.marks if mark.end is not None),
        *(_band(item, across, up) for item in panel.items if isinstance(item, Band)),
        *(_moment(mark, across) for mark in panel.marks if mark.end is None),
        *(_line(item, across, up) for item in panel.items if isinstance(item, Line)),
        "</svg>",
        _frame(across, up, panel.x_title),
        "</svg>",
    ]
    return "".join(parts)


def decimate(x: Array, y: Array, columns: int = COLUMNS) -> tuple[Array, Array]:
    """Reduce to the lowest and the highest point of each column; a column without values becomes one gap.

    Both are in the order of their times, so that no peak is lost.

    Args:
        x: shape (points,), increasing.
        y: shape (points,).
        columns: number of columns between the first point and the last.
    """
    if x.size <= 2 * columns:
        return x, y
    column = np.floor((x - x[0]) / (x[-1] - x[0]) * columns).astype(int)
    starts = np.flatnonzero(np.diff(column, prepend=-1))
    index = np.arange(x.size)
    lowest = np.minimum.reduceat(np.where(np.isfinite(y), y, np.inf), starts)
    highest = np.maximum.reduceat(np.where(np.isfinite(y), y, -np.inf), starts)
    counts = np.diff(np.append(starts, x.size))
    ends = [
        np.minimum.reduceat(np.where(y == np.repeat(extreme, counts), index, x.size), starts)
        for extreme in (lowest, highest)
    ]
    kept = np.unique(np.concatenate([np.where(np.isfinite(lowest), end, starts) for end in (ends[0], ends[1])]))
    return x[kept], y[kept]


@dataclass(frozen=True)
class _Across:
    """The horizontal axis, in pixels."""

    first: float
    last: float

    def pixels(self, x: Array | float) -> Array:
        span = self.last - self.first or 1.0
        return np.asarray(LEFT + (np.asarray(x) - self.first) / span * (WIDTH - LEFT - RIGHT))

    def ticks(self) -> list[tuple[float, str]]:
        result = axis(self.first, self.last, 8)
        ticks = zip(result.ticks, result.labels, strict=True)
        return [(float(self.pixels(tick)), label) for tick, label in ticks if self.first <= tick <= self.last]


def _heights(up: Axis, values: Array) -> Array:
    return np.asarray(TOP + (1.0 - up.share(values)) * (HEIGHT - TOP - BOTTOM))


def _line(line: Line, across: _Across, up: Axis) -> str:
    times, values = decimate(line.x, line.y)
    x, y = across.pixels(times), _heights(up, values)
    step = np.diff(times, prepend=times[0])
    starts = ~np.isfinite(np.append(np.nan, y[:-1])) | (step > GAP * max(float(np.median(step[1:])), 1e-12))
    drawn = []
    for at, height, new in zip(x.tolist(), y.tolist(), starts.tolist(), strict=True):
        if height == height:  # not NaN
            ahead = f"H{at:.1f}V{height:.1f}" if line.steps else f"L{at:.1f} {height:.1f}"
            drawn.append(f"M{at:.1f} {height:.1f}" if new else ahead)
    return f'<path class="line {line.kind}" d="{"".join(drawn)}"/>'


def _band(band: Band, across: _Across, up: Axis) -> str:
    edges = []
    for values in (band.lower, band.upper):
        times, kept = decimate(band.x, values, COLUMNS // 2)
        x, y = across.pixels(times), _heights(up, kept)
        there = np.isfinite(y)
        edges.append(
            [f"{at:.1f} {height:.1f}" for at, height in zip(x[there].tolist(), y[there].tolist(), strict=True)]
        )
    return f'<polygon class="band {band.kind}" points="{" ".join([*edges[0], *reversed(edges[1])])}"/>'


def _span(mark: Mark, across: _Across) -> str:
    first, last = np.clip([mark.x, mark.x if mark.end is None else mark.end], across.first, across.last)
    start, end = float(across.pixels(first)), float(across.pixels(last))
    height = HEIGHT - TOP - BOTTOM
    return f'<rect class="band {mark.kind}" x="{start:.1f}" y="{TOP}" width="{end - start:.1f}" height="{height}"/>'


def _moment(mark: Mark, across: _Across) -> str:
    if not across.first <= mark.x <= across.last:
        return ""
    x = float(across.pixels(mark.x))
    return f'<line class="moment {mark.kind}" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>'


def _grid(up: Axis) -> str:
    drawn = "".join(f"M{LEFT} {y:.1f}H{WIDTH - RIGHT}" for y in _heights(up, up.ticks).tolist())
    return f'<path class="grid" d="{drawn}"/>'


def _frame(across: _Across, up: Axis, x_title: str) -> str:
    floor = HEIGHT - BOTTOM
    parts = [f'<path class="frame" d="M{LEFT} {TOP}V{floor}H{WIDTH - RIGHT}"/>']
    ticks = across.ticks()
    for number, (x, text) in enumerate(ticks, start=1):
        label = text if number < len(ticks) else escape(f"{text} {x_title}".rstrip())
        parts.append(f'<path class="frame" d="M{x:.1f} {floor}v4"/>')
        at, anchor = (x, "middle") if x < WIDTH - LABEL_ROOM else (WIDTH - RIGHT, "end")
        spare = " spare" if (len(ticks) - number) % 2 else ""  # left out where the text is large
        parts.append(f'<text class="across{spare}" x="{at:.1f}" y="{floor + 17}" text-anchor="{anchor}">{label}</text>')
    for y, label in zip(_heights(up, up.ticks).tolist(), up.labels, strict=True):
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{label}</text>')
    return "".join(parts)
