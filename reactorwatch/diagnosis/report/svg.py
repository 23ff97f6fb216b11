"""Plots over time as SVG: small, without scripts, in the colours of the page's style sheet.

A plot has some hundred columns. Where a column has more rows than it can show, its lowest and its highest value are
drawn, in the order of their times, so that no peak is lost.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.axis import Axis, axis

WIDTH, HEIGHT = 900, 250
LEFT, RIGHT, TOP, BOTTOM = 64, 10, 8, 30
COLUMNS = 600
LABEL_ROOM = 40

GAP = 10.0
"""A line is interrupted where the time step exceeds this factor times the median step."""


@dataclass(frozen=True, eq=False)
class Line:
    """Values over time.

    Attributes:
        values: shape (rows,); NaN leaves a gap.
        kind: class in the style sheet.
        text: text in the legend; empty: none.
        held: true if each value holds until the next row.
    """

    values: Array
    kind: str
    text: str = ""
    held: bool = False

    @property
    def extent(self) -> tuple[Array, ...]:
        """Values that the axis has to show."""
        return (self.values,)


@dataclass(frozen=True, eq=False)
class Band:
    """Area between two lines, each of shape (rows,); `kind` and `text` as those of a line."""

    lower: Array
    upper: Array
    kind: str
    text: str = ""

    @property
    def extent(self) -> tuple[Array, ...]:
        """Values that the axis has to show."""
        return self.lower, self.upper


def plot(
    title: str,
    time_min: Array,
    items: Sequence[Line | Band],
    moments_min: Sequence[float] = (),
    shown: tuple[float, float] | None = None,
    unit: str = "min",
) -> str:
    """Plot as an `svg` element.

    Args:
        title: text alternative.
        time_min: shape (rows,), at least two.
        items: lines and bands in drawing order; lines are above the bands.
        moments_min: times of vertical lines.
        shown: lowest and highest value of the axis; None: those of the data.
        unit: unit of the horizontal axis, if it is another variable than time.
    """
    values = np.concatenate([values for item in items for values in item.extent])
    finite = values[np.isfinite(values)]
    across = _Time(float(time_min[0]), float(time_min[-1]))
    low, high = shown or (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    up = axis(low, high, 4)
    area = f'x="{LEFT}" y="{TOP}" width="{WIDTH - LEFT - RIGHT}" height="{HEIGHT - TOP - BOTTOM}"'
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">',
        _grid(up),
        f'<svg {area} viewBox="{LEFT} {TOP} {WIDTH - LEFT - RIGHT} {HEIGHT - TOP - BOTTOM}">',  # cuts off
        *(_band(item, time_min, across, up) for item in items if isinstance(item, Band)),
        *(_vertical(across.place(moment)) for moment in moments_min if across.first <= moment <= across.last),
        *(_line(item, time_min, across, up) for item in items if isinstance(item, Line)),
        "</svg>",
        _frame(across, up, unit),
        "</svg>",
    ]
    return "".join(parts)


def decimate(time_min: Array, values: Array, columns: int = COLUMNS) -> tuple[Array, Array]:
    """Reduce to the lowest and the highest row of each column; a column without values becomes one gap.

    Args:
        time_min: shape (rows,), increasing.
        values: shape (rows,).
        columns: number of columns between the first time and the last.
    """
    if time_min.size <= 2 * columns:
        return time_min, values
    column = np.floor((time_min - time_min[0]) / (time_min[-1] - time_min[0]) * columns).astype(int)
    begin = np.flatnonzero(np.diff(column, prepend=-1))
    place = np.arange(time_min.size)
    lowest = np.minimum.reduceat(np.where(np.isfinite(values), values, np.inf), begin)
    highest = np.maximum.reduceat(np.where(np.isfinite(values), values, -np.inf), begin)
    counts = np.diff(np.append(begin, time_min.size))
    ends = []
    for extreme in (lowest, highest):
        result = values == np.repeat(extreme, counts)
        ends.append(np.minimum.reduceat(np.where(result, place, time_min.size), begin))
    first = np.where(np.isfinite(lowest), ends[0], begin)
    second = np.where(np.isfinite(lowest), ends[1], begin)
    kept = np.unique(np.concatenate([first, second]))
    return time_min[kept], values[kept]


@dataclass(frozen=True)
class _Time:
    first: float
    last: float

    def place(self, time_min: float) -> float:
        return float(self.places(np.array(time_min)))

    def places(self, time_min: Array) -> Array:
        return LEFT + (time_min - self.first) / (self.last - self.first) * (WIDTH - LEFT - RIGHT)

    def ticks(self) -> list[tuple[float, str]]:
        result = axis(self.first, self.last, 8)
        ticks = zip(result.ticks, result.labels, strict=True)
        return [(self.place(float(tick)), label) for tick, label in ticks if self.first <= tick <= self.last]


def _heights(up: Axis, values: Array) -> Array:
    return np.asarray(TOP + (1.0 - up.share(values)) * (HEIGHT - TOP - BOTTOM))


def _line(line: Line, time_min: Array, across: _Time, up: Axis) -> str:
    times, values = decimate(time_min, line.values)
    x, y = across.places(times), _heights(up, values)
    step = np.diff(times, prepend=times[0])
    begins = ~np.isfinite(np.append(np.nan, y[:-1])) | (step > GAP * max(float(np.median(step[1:])), 1e-12))
    drawn = []
    for at, height, new in zip(x.tolist(), y.tolist(), begins.tolist(), strict=True):
        if height == height:  # not NaN
            ahead = f"H{at:.1f}V{height:.1f}" if line.held else f"L{at:.1f} {height:.1f}"
            drawn.append(f"M{at:.1f} {height:.1f}" if new else ahead)
    return f'<path class="line {line.kind}" d="{"".join(drawn)}"/>'


def _band(band: Band, time_min: Array, across: _Time, up: Axis) -> str:
    columns = COLUMNS // 2
    edges = []
    for values in (band.lower, band.upper):
        times, kept = decimate(time_min, values, columns)
        x, y = across.places(times), _heights(up, kept)
        there = np.isfinite(y)
        edges.append(
            [f"{at:.1f} {height:.1f}" for at, height in zip(x[there].tolist(), y[there].tolist(), strict=True)]
        )
    return f'<polygon class="band {band.kind}" points="{" ".join([*edges[0], *reversed(edges[1])])}"/>'


def _vertical(x: float) -> str:
    return f'<line class="moment" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>'


def _grid(up: Axis) -> str:
    drawn = "".join(f"M{LEFT} {y:.1f}H{WIDTH - RIGHT}" for y in _heights(up, up.ticks).tolist())
    return f'<path class="grid" d="{drawn}"/>'


def _frame(across: _Time, up: Axis, unit: str) -> str:
    floor = HEIGHT - BOTTOM
    parts = [f'<path class="frame" d="M{LEFT} {TOP}V{floor}H{WIDTH - RIGHT}"/>']
    ticks = across.ticks()
    for number, (place, text) in enumerate(ticks, start=1):
        label = text if number < len(ticks) else escape(f"{text} {unit}".rstrip())
        parts.append(f'<path class="frame" d="M{place:.1f} {floor}v4"/>')
        at, anchor = (place, "middle") if place < WIDTH - LABEL_ROOM else (WIDTH - RIGHT, "end")
        spare = " spare" if (len(ticks) - number) % 2 else ""  # left out where the text is large
        parts.append(f'<text class="across{spare}" x="{at:.1f}" y="{floor + 17}" text-anchor="{anchor}">{label}</text>')
    for y, label in zip(_heights(up, up.ticks).tolist(), up.labels, strict=True):
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{label}</text>')
    return "".join(parts)
