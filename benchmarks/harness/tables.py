"""Tables of studies as text, exact intervals of what they count, and pages between whose marks they are written."""

import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.stats import binom, binomtest, chi2


def markdown(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as Markdown, its columns lined up."""
    widths = [max(len(row[index]) for row in [heading, *rows]) for index in range(len(heading))]
    lines = ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in (heading, *rows)]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]])


def line(*cells: object) -> str:
    """A row of a table of Markdown as it is printed while a study runs."""
    return f"| {' | '.join(map(str, cells))} |"


def head(*cells: str) -> str:
    """Heading of such a table."""
    return f"{line(*cells)}\n{'|---' * len(cells)}|"


def replace_between(page: Path, begin: str, end: str, text: str) -> None:
    """Write a text between two marks of a page."""
    old = page.read_text(encoding="utf-8")
    if begin not in old or end not in old:
        raise ValueError(f"{page.name} must hold the marks {begin} and {end}")
    page.write_text(f"{old.partition(begin)[0]}{begin}\n{text}{end}{old.partition(end)[2]}", encoding="utf-8")


def stamp() -> str:
    """A sentence with today's date and the commit, so that a reader sees how old numbers are."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return f"Measured on {datetime.now(UTC):%Y-%m-%d} with commit {commit.strip()}."


def poisson_interval(count: int) -> tuple[float, float]:
    """Exact 95 % interval of the mean of a Poisson number (Garwood 1936, Biometrika 28)."""
    low = float(chi2.ppf(0.025, 2 * count)) / 2.0 if count else 0.0
    return low, float(chi2.ppf(0.975, 2 * count + 2)) / 2.0


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Exact 95 % interval of a share (Clopper & Pearson 1934, Biometrika 26)."""
    low, high = binomtest(count, total).proportion_ci(method="exact")
    return float(low), float(high)


def percent(count: int, total: int) -> str:
    """A share in percent with its exact 95 % interval."""
    low, high = share_interval(count, total)
    return f"{100 * count / total:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """95 % interval of a median, between two of the sorted values; the whole range of fewer than six.

    >>> median_interval(range(1, 11))
    (2.0, 9.0)
    """
    ordered = np.sort(np.array(values, dtype=np.float64))
    before = int(binom.ppf(0.025, len(ordered), 0.5)) - 1
    return (float(ordered[before]), float(ordered[-1 - before])) if before >= 0 else (ordered[0], ordered[-1])
