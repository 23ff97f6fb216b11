"""The page of the study: for each figure what the report says, what was found, and whether they agree."""

from collections.abc import Sequence

from benchmarks.study_figures.catalogue import FIGURES
from benchmarks.study_figures.figure import Figure, Finding
from benchmarks.study_figures.methods import methods_table

FOLDER = "study"
"""Folder of the pictures, beside the page."""

_HEAD = """# The original report, figure by figure

This project starts from a report on fault diagnosis of this reactor by an identified model and control limits. Each of
its figures 3 to 27 is here under the number of its caption (in the report's text some are lower by one), with its
claim in our words, our figure, what was found, and the verdict. Its figures 1 and 2 are a block diagram and a
drawing of the reactor. Claims of sections without a figure follow, then the methods of its literature review.

All numbers and pictures on this page were computed by one run of `make reproduce`, with seed {seed}.
{source}
"""

_OWN = "Every record in it is simulated by this software, so anyone can run it again."
_MEASURED = "The models of figures 5, 6 and 11 to 16 are identified from the record {name}; all else is simulated."


def page(found: Sequence[tuple[Figure, Finding]], seed: int, measured: str = "") -> str:
    """The page as Markdown."""
    source = _MEASURED.format(name=measured) if measured else _OWN
    parts = [_HEAD.format(seed=seed, source=source)]
    if len(found) < len(FIGURES):
        parts.append(f"Only {len(found)} of the {len(FIGURES)} entries were asked for in this run.\n")
    summary = [f"| [{figure.heading}](#{_anchor(figure)}) | {finding.verdict.value} |" for figure, finding in found]
    parts.append("\n".join(["| entry | the report's claim is |", "|---|---|", *summary]) + "\n")
    parts += [_entry(figure, finding) for figure, finding in found]
    parts += ["## Methods of the literature review\n", methods_table() + "\n"]
    return "\n".join(parts)


def _entry(figure: Figure, finding: Finding) -> str:
    return "\n".join(
        [
            f"## {figure.heading}\n",
            f"![{figure.title}]({FOLDER}/{figure.file_name})\n",
            f"**The report:** {figure.claim}\n",
            f"**Found:** {finding.text}\n",
            f"**Verdict:** {finding.verdict.value}.\n",
        ]
    )


def _anchor(figure: Figure) -> str:
    """Anchor that GitHub makes of the heading."""
    kept = "".join(letter for letter in figure.heading.lower() if letter.isalnum() or letter in " -")
    return kept.replace(" ", "-")
