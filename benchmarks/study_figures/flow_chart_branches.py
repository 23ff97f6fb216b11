"""Figure 7: the flow chart from data to verdict, for the four records and for three that end elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.study_figures.canvas import GREEN, GREY, ORANGE, PURPLE, SKY, VERMILION, panels
from benchmarks.study_figures.figure import Finding, Verdict
from benchmarks.study_figures.flow_chart import Conclusion, follow
from benchmarks.study_figures.report_scheme import ORDER
from benchmarks.study_figures.study import FAST_PERIOD_MIN, TRAINING_ROWS, Study, levels, row_times
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from plant_node.scenario import RandomSteps
from reactorwatch.identification.structure import Structure
from reactorwatch.process.library.cstr_operation import OPERATION
from reactorwatch.records.record import Record

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

_OUTPUT = "T"
_QUESTIONS = ("is the sampling rate good?", "is there a mismatch?", "are the parameters accurate?")
_COLOURS = {"fault free": GREEN, "fault": VERMILION, "sample again": ORANGE, "identify again": PURPLE}
_PERIOD_MIN = 0.1
_WATCHED_ROWS = 2000


def draw(study: Study, drawing: Drawing) -> Finding:
    """A row for each record: the answers, and where the chart ended."""
    ends = {
        preset.name: (_follow(study.fault_record(preset.name), TRAINING_ROWS), bool(preset.settings["faults"]))
        for preset in OPERATION.presets
    }
    fast = study.fast(noise=False)
    extra = {
        f"no fault, every {FAST_PERIOD_MIN:g} min": _follow(fast, fast.rows // 2),
        "no fault, 40 min of +-0.5 l/min": _follow(_small_then_large(study, 0.5, 400), 400),
        "no fault, 100 min of +-2 l/min": _follow(_small_then_large(study, 2.0, TRAINING_ROWS), TRAINING_ROWS),
    }
    everything = {name: conclusion for name, (conclusion, _) in ends.items()} | extra
    misled = [name for name, conclusion in extra.items() if conclusion.verdict == "fault"]
    wrong = [name for name, (conclusion, faulty) in ends.items() if (conclusion.verdict == "fault") != faulty]
    _boxes(drawing, everything, [*wrong, *misled])
    lines = ["| record | verdict | why |", "|---|---|---|"]
    for name, conclusion in everything.items():
        why = "; ".join(f"{branch.question} **{branch.answer}**: {branch.why}" for branch in conclusion.branches)
        lines.append(f"| {name} | {conclusion.verdict} | {why} |")
    right = len(ends) - len(wrong)
    text = (
        f"Third-order ARX of {_OUTPUT}. Right in {right} of {len(ends)} named records. The last three have no fault "
        "and are there for the other ends of the chart: one sampled too fast, two learned from small moves of the "
        "coolant and then watched under moves of +-10 l/min.\n\n" + "\n".join(lines) + "\n\n"
    )
    if misled:
        text += (
            f"The chart calls this a fault and is wrong: {', '.join(misled)}. With enough rows the parameters of a "
            "linear model are precise and yet not right elsewhere, for the plant is curved; their standard "
            "deviations know nothing of that. So a model must be learned where the plant will be watched.\n\n"
        )
    text += (
        "The report goes on to isolation, identification and reconstruction of the fault and shows none of them. "
        "Beside the monitor, which does: [the scheme and the monitor](#the-reports-scheme-beside-the-monitor)."
    )
    return Finding(text, Verdict.IN_PART if right else Verdict.DISAGREES)


def _follow(record: Record, trusted_rows: int) -> Conclusion:
    columns = record.columns
    return follow(Structure.of_order(ORDER), columns["qc"], columns[_OUTPUT], record.time_min, trusted_rows)


def _small_then_large(study: Study, small: float, rows: int) -> Record:
    """A plant without a fault, driven by small random steps about 100 l/min for some rows, then by large ones."""
    time_min = row_times(rows + _WATCHED_ROWS, _PERIOD_MIN)
    parts = [
        levels(RandomSteps(100.0 - size, 100.0 + size, 1.0), times, study.seed)
        for size, times in ((small, time_min[:rows]), (10.0, time_min[rows:]))
    ]
    driver = Record(time_min, {"qc": np.concatenate(parts)}, "random steps")
    return simulate_record(PlantConfig(seed=study.seed, period_min=_PERIOD_MIN), time_min.size, driver=driver)


def _boxes(drawing: Drawing, conclusions: dict[str, Conclusion], wrong: list[str]) -> None:
    (axes,) = panels(drawing, 1, 1)
    axes.set_axis_off()
    axes.set_xlim(0, 10)
    axes.set_ylim(-len(conclusions) + 0.4, 1.0)
    columns = dict(zip(_QUESTIONS, (3.7, 5.6, 7.5), strict=True))
    for question, x in columns.items():
        axes.text(x, 0.7, question.replace(" ", "\n", 2).replace("\n", " ", 1), ha="center", va="center", fontsize=9)
    for row, (name, conclusion) in enumerate(conclusions.items()):
        axes.text(0.0, -row, name, va="center", fontsize=9.5)
        last = 2.9
        for branch in conclusion.branches:
            x = columns[branch.question]
            axes.annotate(
                "",
                (x - 0.42, -row),
                (last, -row),
                arrowprops={"arrowstyle": "->", "color": GREY, "shrinkA": 0, "shrinkB": 0},
            )
            _box(axes, x, row, branch.answer, SKY if branch.answer == "yes" else "#dddddd")
            last = x + 0.35
        axes.annotate(
            "", (8.45, -row), (last, -row), arrowprops={"arrowstyle": "->", "color": GREY, "shrinkA": 0, "shrinkB": 0}
        )
        said = conclusion.verdict + (" (wrong)" if name in wrong else "")
        _box(axes, 9.2, row, said, _COLOURS[conclusion.verdict], bold=True)


def _box(axes: Axes, x: float, row: int, text: str, colour: str, bold: bool = False) -> None:
    axes.text(
        x,
        -row,
        text,
        ha="center",
        va="center",
        fontsize=9.5,
        fontweight="bold" if bold else "normal",
        bbox={"boxstyle": "round,pad=0.35", "facecolor": colour, "edgecolor": "none", "alpha": 0.85 if bold else 1.0},
    )
