"""Figures of the study and their findings, drawn in the style of `reactorwatch.figures`.

The same drawing gives the same bytes. Colours are those of Okabe & Ito (2008), Color Universal Design.
"""

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Drawing
from PIL import Image

from reactorwatch.figures import DPI, figure_png, plain_style
from reactorwatch.records.write import atomic_write

if TYPE_CHECKING:
    from benchmarks.study_figures.study import Study


class Verdict(Enum):
    """Agreement of a finding with the report."""

    AGREES = "confirmed"
    IN_PART = "confirmed in part"
    DISAGREES = "corrected"
    NO_CLAIM = "the report states no result"


@dataclass(frozen=True)
class Finding:
    """Finding of a figure."""

    text: str  # Markdown, with the numbers of this run
    verdict: Verdict = Verdict.NO_CLAIM  # agreement with the report


@dataclass(frozen=True)
class Figure:
    """One figure of the report, or one of its sections that has a claim and no figure."""

    key: str  # number of the report's caption, such as `8`; `section-` and a word for a section
    title: str  # subject of the figure
    claim: str  # statement of the report, in our words
    draw: Callable[["Study", Drawing], Finding]  # function that puts it on an empty drawing and returns the finding
    height_px: int = 500  # height of the picture, which is 900 px wide

    @property
    def heading(self) -> str:
        """Heading of its entry."""
        if self.key.startswith("section-"):
            return self.title
        return f"{'Figures' if '-' in self.key else 'Figure'} {self.key.replace('-', ' to ')}: {self.title}"

    @property
    def file_name(self) -> str:
        """File name of the picture."""
        return f"{self.key}.png" if self.key.startswith("section-") else f"figure-{self.key.zfill(2)}.png"


def verdict(agrees: bool) -> Verdict:
    """Verdict on a claim that is right or wrong as a whole."""
    return Verdict.AGREES if agrees else Verdict.DISAGREES


BLACK, GREY = "#000000", "#8c8c8c"
BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE = "#56B4E9", "#CC79A7"
BY_ORDER = {1: ORANGE, 2: BLUE, 3: VERMILION}

WIDTH_PX = 900
_PALETTE = 256  # colours in a file: a third of the bytes


@contextmanager
def paper(path: Path, height_px: int) -> Iterator[Drawing]:
    """An empty drawing, which is written to `path` (PNG) when the block ends without an error."""
    with plain_style():
        drawing = Drawing(figsize=(WIDTH_PX / DPI, height_px / DPI), dpi=DPI, layout="constrained")
        FigureCanvasAgg(drawing)
        yield drawing
        pixels = figure_png(drawing)
    picture = (
        Image.open(io.BytesIO(pixels))
        .convert("RGB")
        .quantize(_PALETTE, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    )
    with atomic_write(path) as temporary:
        picture.save(temporary, format="PNG", optimize=True)


def panels(drawing: Drawing, rows: int, columns: int, **options: Any) -> list[Axes]:
    """Axes in a grid, row by row."""
    return list(drawing.subplots(rows, columns, squeeze=False, **options).ravel())


def label(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Name what is on the axes; an empty name is left out."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if title:
        axes.set_title(title)


def legend_below(drawing: Drawing, axes: Axes, columns: int, extra: Sequence[Any] = ()) -> None:
    """One legend for the whole drawing, under it."""
    handles, _ = axes.get_legend_handles_labels()
    drawing.legend(handles=[*handles, *extra], loc="outside lower center", ncols=columns)
