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

    AGREES = "agrees"
    IN_PART = "agrees in part"
    DISAGREES = "disagrees"
    NO_CLAIM = "no result of the report is known"


@dataclass(frozen=True)
class Finding:
    """Finding of a figure.

    Attributes:
        text: Markdown, with the numbers of this run.
        verdict: agreement with the report.
    """

    text: str
    verdict: Verdict = Verdict.NO_CLAIM


@dataclass(frozen=True)
class Figure:
    """One figure of the report.

    Attributes:
        number: number in the study, in the report's order.
        title: subject of the figure.
        claim: statement of the report, as far as it is known.
        draw: function that puts it on an empty drawing and returns the finding.
        height_px: height of the picture, which is 900 px wide.
    """

    number: int
    title: str
    claim: str
    draw: Callable[[Study, Drawing], Finding]
    height_px: int = 500

    @property
    def file_name(self) -> str:
        """File name of the picture."""
        return f"figure-{self.number:02d}.png"


def verdict(agrees: bool) -> Verdict:
    """Verdict on a claim that is right or wrong as a whole."""
    return Verdict.AGREES if agrees else Verdict.DISAGREES
