"""Figures of the study, and their findings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

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
    draw: Callable[[Study, Drawing], Finding]  # function that puts it on an empty drawing and returns the finding
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
