"""Identified models in a notebook."""

from typing import TYPE_CHECKING

from reactorwatch.identification.identify import HeldOutRun, Identification
from reactorwatch.notebook import html
from reactorwatch.notebook.figures import MEASURED, MODEL, Line, Panel, draw_panels
from reactorwatch.notebook.frames import make_frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

STEP = "#2ca02c"


def identification_html(found: Identification) -> str:
    """Kind, order and fits of a model, and the checks of the record."""
    checks = [(name, result) for name, result in found.checks.items()]
    fit = found.fit_percent
    return "".join(
        [
            html.headline(
                f"{found.model} of order {found.order}, delay {found.delay}, for {found.output}: "
                f"free run {fit.free_run:.2f} %, one step {fit.one_step:.2f} %"
            ),
            html.sentence(f"{found.rows} rows were fitted; the fits are of rows that were not."),
            html.table(("check", "result"), checks),
        ]
    )


def held_out_frame(found: Identification, run: HeldOutRun) -> "DataFrame":
    """Held-out rows: measured, predicted one step ahead, and simulated."""
    name = found.output
    columns = {"time_min": run.time, name: run.measured, f"{name}.one_step": run.one_step, f"{name}.free_run": run.free}
    return make_frame(columns, "time_min")


def plot_identification(found: Identification, run: HeldOutRun, unit: str) -> "Figure":
    """Held-out rows with the free run and the one-step-ahead prediction, and their errors."""
    lines = (
        Line("measured", run.time, run.measured, MEASURED),
        Line("free run", run.time, run.free, MODEL),
        Line("one step", run.time, run.one_step, STEP),
    )
    errors = (
        Line("free run", run.time, run.measured - run.free, MODEL),
        Line("one step", run.time, run.measured - run.one_step, STEP),
    )
    in_unit = f", {unit}" if unit else ""
    return draw_panels([Panel(f"{found.output}{in_unit}", lines), Panel(f"error{in_unit}", errors)])
