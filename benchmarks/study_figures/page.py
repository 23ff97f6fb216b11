"""The page of the study: for each figure what the report says, what was found, and whether they agree."""

from collections.abc import Sequence

from benchmarks.study_figures.catalogue import FIGURES
from benchmarks.study_figures.figure import Figure, Finding

FOLDER = "study"
"""Folder of the pictures, beside the page."""

_HEAD = """# The report's figures, reproduced

The work that this project starts from is a report on watching this reactor by its model. We do not have the report
itself: its figures 4 to 20 are reproduced here by subject, from the description of that work, in the report's order,
and the figure numbers are those of this study's own mapping.

All numbers and pictures on this page were computed by one run of `reactorwatch reproduce -o DIR --seed {seed}`; no
result is typed in. {source}
"""

_OWN = "Every record in it is simulated by this software, so anyone can run it again."
_MEASURED = "The models of figures 14 to 17 are identified from the record {name}; all else is simulated."


def page(found: Sequence[tuple[Figure, Finding]], seed: int, measured: str = "") -> str:
    """The page as Markdown.

    Args:
        found: the figures that were drawn, in order, with what was found.
        seed: seed of the run.
        measured: name of the record that the models are identified from; empty if it was simulated.
    """
    source = _MEASURED.format(name=measured) if measured else _OWN
    parts = [_HEAD.format(seed=seed, source=source)]
    if len(found) < len(FIGURES):
        parts.append(f"Only {len(found)} of the {len(FIGURES)} figures were asked for in this run.\n")
    summary = [
        f"| [{figure.number}](#{_anchor(figure)}) | {figure.title} | {finding.verdict.value} |"
        for figure, finding in found
    ]
    parts.append("\n".join(["| figure | subject | compared with the report |", "|---|---|---|", *summary]) + "\n")
    parts += [_entry(figure, finding) for figure, finding in found]
    return "\n".join(parts)


def _entry(figure: Figure, finding: Finding) -> str:
    return "\n".join(
        [
            f"## {_heading(figure)}\n",
            f"![{figure.title}]({FOLDER}/{figure.file_name})\n",
            f"**The report:** {figure.claim}\n",
            f"**Found:** {finding.text}\n",
            f"**Verdict:** {finding.verdict.value}.\n",
        ]
    )


def _heading(figure: Figure) -> str:
    return f"Figure {figure.number}: {figure.title}"


def _anchor(figure: Figure) -> str:
    """Anchor that GitHub makes of the heading."""
    kept = "".join(letter for letter in _heading(figure).lower() if letter.isalnum() or letter in " -")
    return kept.replace(" ", "-")
