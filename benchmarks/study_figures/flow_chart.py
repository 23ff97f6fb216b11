"""The report's flow chart from data to verdict, with the answer to each question and its reason.

    data -> is the sampling rate good? -no-> sample again
                 | yes
            model, from the trusted rows; limits: mean +- 3 sigma of its residual there (SPC)
                 |
            is there a mismatch in the other rows? -no-> fault free
                 | yes
            are the parameters accurate there? -no-> identify again
                 | yes
               fault

With a true model 0.27 % of the residuals are outside their limits; if the share in training is larger, it is used
instead. There is a mismatch if the number outside is improbable under that share (binomial). Parameters are accurate
for a row if their uncertainty contributes less to its prediction error than noise does, phi' cov phi < sigma^2; that
fails outside the operating range of the training.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from numpy.typing import ArrayLike
from scipy.stats import binom

from benchmarks.study_figures.report_scheme import ORDER
from benchmarks.study_figures.study import (
    BLACK,
    FAST_PERIOD_MIN,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    TRAINING_ROWS,
    VERMILION,
    Finding,
    Study,
    Verdict,
    levels,
    panels,
    row_times,
)
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from plant_node.scenario import RandomSteps
from reactorwatch.errors import InputError
from reactorwatch.identification.checks import Check, check_record, sampling
from reactorwatch.identification.data import ScaledRecord, rows_of
from reactorwatch.identification.linear import fit_linear
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.structure import Structure, as_columns
from reactorwatch.process.library.cstr_operation import OPERATION
from reactorwatch.records.record import Record

OUTSIDE_THREE_SIGMA = 0.0027
MISMATCH_MINUS_LOG10_P = 6.0


class Branch(NamedTuple):
    """One question of the chart."""

    question: str  # the question
    answer: str  # "yes" or "no"
    why: str  # the numbers behind the answer


@dataclass(frozen=True)
class Conclusion:
    """Result of the chart."""

    verdict: str  # "sample again", "fault free", "identify again" or "fault"
    branches: tuple[Branch, ...]  # the questions in order
    model: LinearModel | None = None  # the fitted model; None if the chart ended before it
    lower_limit: float = math.nan  # lower limit of the residual, in the output's unit; NaN without a model
    upper_limit: float = math.nan  # upper limit of the residual; NaN without a model


def follow(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
    trusted_rows: int | None = None,
) -> Conclusion:
    """Apply the chart to a record."""
    u, y = as_columns(inputs, "inputs", structure.inputs), as_columns(outputs, "outputs", 1)
    t = np.arange(len(y), dtype=np.float64) if time is None else np.asarray(time, dtype=np.float64)
    trusted = len(y) // 2 if trusted_rows is None else trusted_rows
    if not 0 < trusted < len(y):
        raise InputError(f"trusted_rows must be between 1 and {len(y) - 1}, got {trusted}")
    training, watched = (u[:trusted], y[:trusted], t[:trusted]), (u[trusted:], y[trusted:], t[trusted:])

    for check in check_record(structure, *training):
        if check.name in ("variation", "excitation") and not check.passed:
            raise InputError(check.result)
    rate = sampling(ScaledRecord.of(structure, *training))
    branches = [Branch("is the sampling rate good?", _answer(rate.passed), _sampling_text(rate))]
    if not rate.passed:
        return Conclusion("sample again", tuple(branches))

    model = fit_linear("arx", structure, *training)
    known = model.residuals(*training)[:, 0]
    known = known[np.isfinite(known)]
    centre, sigma = float(np.mean(known)), float(np.std(known, ddof=structure.parameters))
    lower, upper = centre - 3.0 * sigma, centre + 3.0 * sigma
    usual = max(OUTSIDE_THREE_SIGMA, float(np.mean((known < lower) | (known > upper))))
    residuals = model.residuals(*watched)[:, 0]
    present = np.isfinite(residuals)
    if not np.any(present):
        raise InputError(f"none of the {len(residuals)} rows after the trusted ones can be predicted")
    outside = present & ((residuals < lower) | (residuals > upper))
    improbable = _minus_log10_tail(int(outside.sum()), int(present.sum()), usual)
    mismatch = improbable >= MISMATCH_MINUS_LOG10_P
    why = (
        f"{outside.sum()} of {present.sum()} residuals are outside {lower:.3g} to {upper:.3g}, "
        f"{100 * usual:.2g} % are usual: -log10 p = {improbable:.1f}"
    )
    branches.append(Branch("is there a mismatch?", _answer(mismatch), why))
    if not mismatch:
        return Conclusion("fault free", tuple(branches), model, lower, upper)

    rows = rows_of(structure, *watched)
    regressors = rows.regressors[np.isin(rows.position, np.flatnonzero(outside))]
    added = np.einsum("ij,jk,ik->i", regressors, model.covariance, regressors)
    ratio = math.sqrt(float(np.median(added))) / sigma if sigma > 0.0 else 0.0
    accurate = ratio < 1.0
    why = (
        f"uncertain parameters add {ratio:.2g} of the noise's standard deviation to those predictions, at most 1 may be"
    )
    branches.append(Branch("are the parameters accurate?", _answer(accurate), why))
    return Conclusion("fault" if accurate else "identify again", tuple(branches), model, lower, upper)


def _answer(answer: bool) -> str:
    return "yes" if answer else "no"


def _sampling_text(rate: Check) -> str:
    return f"a step response takes {rate.value:.0f} samples" if rate.passed else rate.result


def _minus_log10_tail(count: int, of: int, share: float) -> float:
    """-log10 of the probability of at least `count` among `of` rows, each with the probability `share`."""
    if count == 0:
        return 0.0
    logarithm = float(binom.logsf(count - 1, of, share))
    if math.isfinite(logarithm):
        return abs(logarithm) / math.log(10.0)
    # Chernoff's bound, where the probability itself underflows: -log p >= of D(count / of || share).
    seen = count / of
    rest = (1.0 - seen) * math.log((1.0 - seen) / (1.0 - share)) if seen < 1.0 else 0.0
    return of * (seen * math.log(seen / share) + rest) / math.log(10.0)


_OUTPUT = "T"
_QUESTIONS = ("is the sampling rate good?", "is there a mismatch?", "are the parameters accurate?")
_COLOURS = {"fault free": GREEN, "fault": VERMILION, "sample again": ORANGE, "identify again": PURPLE}
_PERIOD_MIN = 0.1
_WATCHED_ROWS = 2000


def draw_branches(study: Study, drawing: Drawing) -> Finding:
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


_REPORT = (
    "qc and C\nof the plant",
    "scaling",
    "lags of\nevery 6th row",
    "pseudo-inverse",
    "model, run on\nits own output",
    "mean +- 3 sigma\nof the residual",
)
_MONITOR = (
    "samples\non the bus",
    "aligned rows,\nsignal checks",
    "filter of the\nequations, or ARX",
    "charts of the\ninnovations",
    "alarms with\non-delay",
    "likely cause",
)


def draw_data_flow(_study: Study, drawing: Drawing) -> Finding:
    """Both chains of blocks, one above the other."""
    (axes,) = panels(drawing, 1, 1)
    axes.set_axis_off()
    axes.set_xlim(-0.6, 5.6)
    axes.set_ylim(-0.9, 1.7)
    _chain(axes, 1.0, _REPORT, ORANGE, "the report's diagrams: identification, then simulation")
    _chain(axes, 0.0, _MONITOR, SKY, "the monitor")
    text = (
        "The report's appendix has seven block diagrams: for ARX of orders 1 and 2 and for output-error models of "
        "orders 1 to 3 the identification, and for ARX the simulation. They differ in the number of delays alone, and "
        "are one "
        "chain. It is computed by `benchmarks/study_figures/report_scheme.py`; the "
        "monitor's own chain is drawn below it."
    )
    return Finding(text)


def _chain(axes: Axes, height: float, blocks: tuple[str, ...], colour: str, title: str) -> None:
    axes.text(-0.5, height + 0.42, title, fontsize=10, color=BLACK)
    for place, block in enumerate(blocks):
        axes.text(
            place, height, block, ha="center", va="center", fontsize=8.5,
            bbox={"boxstyle": "round,pad=0.45", "facecolor": colour, "edgecolor": "none", "alpha": 0.8},
        )  # fmt: skip
        if place:
            axes.annotate(
                "", (place - 0.42, height), (place - 0.58, height), arrowprops={"arrowstyle": "->", "color": GREY}
            )
