"""The catalogue of the report's figures, by the numbers of their captions, and the page of them.

A new figure is a function that draws it and returns what it found, and a line here; what it found is computed in that
run, never typed in. The report's text refers to several figures by a number one lower than their caption has. Its
figures 1 and 2 show no result: a block diagram and a drawing of the reactor.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from benchmarks.study_figures import fault_records, flow_chart, models, plant, sampling
from benchmarks.study_figures.measured_records import measured_figure
from benchmarks.study_figures.study import Figure, Finding, Study, paper

_ORDERS = {1: "first", 2: "second", 3: "third"}
_RECORDS = {
    "17": ("Concentration without a fault", "No fault is detected, and none is there."),
    "18": ("Concentration with input leakage", "The residual shows the fault, a leak of the input."),
    "19": ("Concentration with a changed internal parameter", "The residual shows a change inside the plant."),
    "20": ("Concentration with another changed parameter", "The residual shows another change inside the plant."),
}


def _model(key: str, family: str, order: int) -> Figure:
    title = f"{'ARX' if family == 'arx' else 'OE'}({order},{order}) against the plant"
    claim = f"A model of the {_ORDERS[order]} order predicts the plant's output."
    if order == max(_ORDERS):
        claim += " Of the three orders it predicts best, and its probability of noise is higher."
    return Figure(key, title, claim, partial(models.compare_orders, family=family, order=order))


FIGURES: tuple[Figure, ...] = (
    Figure(
        "3",
        "The plant's responses over the coolant flow",
        "At 85 to 95 l/min the response is of first order; beyond 100 l/min it oscillates before it settles.",
        plant.step_responses,
        height_px=640,
    ),
    Figure(
        "4",
        "Steady states over the coolant flow",
        "The plant has several steady states; its operating point is qc = 100 l/min, T = 438.54 K, C = 0.103 mol/l.",
        plant.steady_state_curve,
        height_px=640,
    ),
    Figure("5", "Identification of the ARX(3,3) model", "A scheme of its estimation.", models.estimate),
    Figure("6", "Simulation of the ARX(3,3) model", "An acceptable estimate of the plant's response.", models.simulate),
    Figure(
        "7",
        "The diagnosis scheme",
        "Data, sampling rate good?, model, SPC, mismatch?, parameters accurate?, fault or fault free.",
        flow_chart.draw_branches,
    ),
    Figure(
        "8",
        "C after a unit step at 100 l/min, plant and linear model",
        "The linear model estimates the response around the steady state.",
        partial(plant.unit_step, name="C"),
    ),
    Figure(
        "9",
        "T after a unit step at 100 l/min, plant and linear model",
        "The linear model estimates the response around the steady state; T behaves in a nonlinear way.",
        partial(plant.unit_step, name="T"),
    ),
    Figure(
        "10",
        "One linear model at 85, 100 and 110 l/min",
        "After a large step the linear model is off, after a short time it is accurate; at 110 l/min it is not. It is "
        "accurate at the operating point only.",
        plant.compare_linear,
        height_px=560,
    ),
    *(_model(str(10 + order), "arx", order) for order in _ORDERS),
    *(_model(str(13 + order), "oe", order) for order in _ORDERS),
    *(
        Figure(key, title, claim, partial(fault_records.draw_record, key=key))
        for key, (title, claim) in _RECORDS.items()
    ),
    Figure(
        "21-27",
        "Block diagrams of identification and simulation",
        "Simulink diagrams of the models.",
        flow_chart.draw_data_flow,
        360,
    ),
    Figure(
        "section-conclusion",
        "The report's scheme beside the monitor",
        "The diagnosis performance is good, and the approach detects, isolates and identifies a fault.",
        fault_records.compare,
    ),
    Figure(
        "section-best-model",
        "The best model",
        "The third order predicts best. As further work the report recommends a neural network.",
        models.best_model,
    ),
    Figure(
        "section-steady-states",
        "Phase plane",
        "The nonlinear plant has several steady states.",
        plant.phase_plane,
    ),
    Figure(
        "section-excitation",
        "Excitation",
        "A single sinusoid must be avoided; sums of sinusoids and square waves are good.",
        sampling.excitation,
        height_px=640,
    ),
    Figure(
        "section-sampling-rate",
        "Sampling rate",
        "Sampling too fast makes neighbouring outputs equal and the regressor matrix singular; the M-files take every "
        "6th row from the 100th on, with lags in samples of the fast clock.",
        sampling.sampling_rate,
    ),
)

METHODS = """| method | meaning | place in this software |
|---|---|---|
| linearisation by Taylor series | linear model at a steady state | `reactorwatch linearise` |
| feedback linearisation | state feedback that cancels the nonlinearity | none: it is a controller, not a monitor |
| white-box model | balances and laws of nature | process with equations; reference `equations` |
| grey-box model | balances with parts learned from data | `diagnose`, which extends the equations by what it finds |
| black-box model | relation of input and output alone | `identify`; references `black-box` and `arx` |
| ARX, least squares | linear in its parameters | `identify --model arx`, also row by row (`--recursive`) |
| ARMAX | ARX with a model of the noise | `identify --model armax` |
| output error | fitted by its simulation | `identify --model oe` |
| Shewhart limits, mean +- 3 sigma | one point at a time | chart `shewhart` |
| multivariate control charts | outputs judged together, with their correlation | charts `t2` and `mewma` |
| PCA, contribution plots | few directions explain many signals; shares of an alarm | chart `pca`; `contributions` of each alarm |
| PLS | directions that explain a quality variable | none yet: no process here has a quality variable apart from its outputs |
| multi-way PCA | batches unfolded over time | none yet: the processes here run continuously |
| several PCA models, soft partition | one model for each regime | none yet: a mode has a reference of its own instead |
| neural network (recommended) | nonlinear predictor | none: no product, only a figure of this study (`benchmarks/study_figures/neural.py`) |
"""  # noqa: E501
"""Methods of the report's literature review."""

FOLDER = "study"
"""Folder of the pictures, beside the page."""

_HEAD = """# The original report, figure by figure

This project starts from a report on fault diagnosis of this reactor by an identified model and control limits. Each of
its figures 3 to 27 is here under the number of its caption (in the report's text some are lower by one), with its
claim in our words, our figure, what was found, and the verdict. Its figures 1 and 2 are a block diagram and a
drawing of the reactor. Claims of sections without a figure follow, then the methods of its literature review.

All numbers and pictures on this page were computed by one run of `make reproduce`, with seed {seed}.
Every record in it is simulated by this software, so anyone can run it again.
"""


def page(found: Sequence[tuple[Figure, Finding]], seed: int) -> str:
    """The page as Markdown."""
    parts = [_HEAD.format(seed=seed)]
    if len(found) < len(FIGURES):
        parts.append(f"Only {len(found)} of the {len(FIGURES)} entries were asked for in this run.\n")
    summary = [f"| [{figure.heading}](#{_anchor(figure)}) | {finding.verdict.value} |" for figure, finding in found]
    parts.append("\n".join(["| entry | the report's claim is |", "|---|---|", *summary]) + "\n")
    parts += [_entry(figure, finding) for figure, finding in found]
    parts += ["## Methods of the literature review\n", METHODS]
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


class Job(NamedTuple):
    """A figure to be drawn."""

    key: str  # key of the figure
    picture: Path  # file of the picture
    seed: int  # seed of every simulated record
    data: Path | None = None  # folder of records of others


def entries(data: Path | None) -> Sequence[Figure]:
    """All figures, with the entry of a folder of records of others if there is one."""
    return FIGURES if data is None else (*FIGURES, measured_figure(data))


def draw(job: Job) -> Finding:
    """Draw a figure; not in `__main__`, whose functions a worker process does not find."""
    (figure,) = (item for item in entries(job.data) if item.key == job.key)
    with paper(job.picture, figure.height_px) as drawing:
        return figure.draw(Study(job.seed), drawing)
