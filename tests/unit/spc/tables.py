"""The table of docs/charts.md: run lengths as computed, beside the published ones.

`python -m tests.unit.spc.tables` writes it into the page.
"""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from reactorwatch.spc.charts.cusum import cusum_run_length
from reactorwatch.spc.charts.ewma import ewma_run_length
from reactorwatch.spc.charts.mewma import mewma_run_length
from reactorwatch.spc.charts.shewhart import shewhart_run_length
from reactorwatch.spc.charts.t2 import t2_run_length
from tests.unit.spc import published

PAGE = Path(__file__).resolve().parents[3] / "docs" / "charts.md"
BEGIN, END = "<!-- tests/unit/spc/tables.py -->\n", "<!-- end -->\n"
SHIFTS = (0.0, 0.5, 1.0, 2.0, 3.0)


def rows() -> Iterator[tuple[str, Callable[[float], float], dict[float, float]]]:
    """Each chart: what to call it, its run length by shift, and the published ones."""
    for rules, lengths in published.RUN_RULES.items():
        yield f"Shewhart, rules {','.join(map(str, rules))}", partial(shewhart_run_length, rules=rules), lengths
    for (h, start), lengths in published.CUSUM.items():
        name = f"CUSUM k 0.5, h {h:g}" + (f", head start {start:g}" if start else "")
        yield name, partial(cusum_run_length, k=0.5, h=h, head_start=start), lengths
    for (weight, limit), lengths in published.EWMA.items():
        yield f"EWMA {weight:g}, L {limit:g}", partial(ewma_run_length, weight=weight, limit=limit), lengths
    for (p, weight, limit), lengths in published.MEWMA.items():
        computed = partial(mewma_run_length, dimension=p, weight=weight, limit=limit)
        yield f"MEWMA p {p}, {weight:g}, H {limit:g}", computed, lengths
    for (p, limit), lengths in published.T2.items():
        yield f"T2 p {p}, limit {limit:g}", partial(t2_run_length, dimension=p, limit=limit), lengths


def table() -> str:
    """The table, in Markdown."""
    lines = ["| chart | " + " | ".join(f"{shift:g}" for shift in SHIFTS) + " | largest deviation |"]
    lines.append("|---" * (len(SHIFTS) + 2) + "|")
    for name, computed, lengths in rows():
        cells = [f"{digits(computed(d))} ({lengths[d]:g})" if d in lengths else digits(computed(d)) for d in SHIFTS]
        deviation = max(abs(computed(d) / length - 1.0) for d, length in lengths.items())
        lines.append(f"| {name} | {' | '.join(cells)} | {100 * deviation:.2f} % of {len(lengths)} |")
    return "\n".join(lines) + "\n"


def digits(length: float) -> str:
    """Five digits, as the best of the published tables."""
    return f"{length:.5g}"


def main() -> None:
    """Write the table into the page."""
    page = PAGE.read_text()
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    PAGE.write_text(before + BEGIN + table() + END + after)


if __name__ == "__main__":
    main()
