"""Diagnoses in a notebook."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from reactorwatch.diagnosis.report.words import describe_causes, describe_size, describe_timing, describe_verdict
from reactorwatch.diagnosis.result import Diagnosis
from reactorwatch.notebook import html
from reactorwatch.notebook.figures import MEASURED, MODEL, Line, Mark, Panel, draw_panels
from reactorwatch.notebook.frames import frame_of_rows
from reactorwatch.process.effect import Effect

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from reactorwatch.diagnosis.result import Curves

COLUMNS = ("explanation", "delta_bic", "cause", "profile", "label", "location", "size", "size_sd", "unit", "onset_min")
AFTER = "#2ca02c"


def diagnosis_frame(diagnosis: Diagnosis) -> "DataFrame":
    """A row for each cause of each explanation; 0 is the named one, the others are alternatives."""
    explanations = [(diagnosis.causes, 0.0), *((item.explanation, item.delta_bic) for item in diagnosis.alternatives)]
    rows: list[dict[str, Any]] = []
    for number, (causes, worse) in enumerate(explanations):
        for cause in causes:
            size, onset = cause.parameters["size"], cause.parameters.get("onset")
            values = (number, worse, cause.cause, cause.profile, cause.label, cause.location)
            sizes = (size.value, size.sd, size.unit, None if onset is None else onset.value)
            rows.append(dict(zip(COLUMNS, (*values, *sizes), strict=True)))
    return frame_of_rows(rows, COLUMNS)


def diagnosis_html(diagnosis: Diagnosis, effects: Sequence[Effect]) -> str:
    """Verdict, causes with their sizes, alternatives and errors on rows that were not fitted."""
    causes = [
        (cause.label, cause.cause, cause.location, describe_size(cause, effects), describe_timing(cause))
        for cause in diagnosis.causes
    ]
    others = [(describe_causes(item.causes, effects), f"{item.delta_bic:.1f}") for item in diagnosis.alternatives]
    errors = [
        (f"{name}, {item.unit}", f"{item.rmse_before:.3g}", f"{item.rmse_after:.3g}", f"{item.noise_sd:.3g}")
        for name, item in diagnosis.gain.held_out.items()
    ]
    return "".join(
        [
            html.headline(describe_verdict(diagnosis)),
            html.table(("cause", "name", "where", "size (95 %)", "when"), causes),
            html.table(("or", "worse by, in BIC"), others),
            html.table(("error of the simulation", "as it was", "extended", "noise"), errors),
            *map(html.sentence, diagnosis.remarks),
        ]
    )


def plot_diagnosis(diagnosis: Diagnosis, curves: "Curves", units: dict[str, str]) -> "Figure":
    """Measurements of each output with the simulation as it was and the extended one, and the onsets of causes."""
    x, panels = curves.time_min, []
    for name, measured in curves.measured.items():
        lines = [
            Line("measured", x, measured, MEASURED),
            Line("simulation as it was", x, curves.simulated_before[name], MODEL),
        ]
        if diagnosis.causes:
            lines.append(Line("extended simulation", x, curves.simulated_after[name], AFTER))
        panels.append(Panel(f"{name}, {units[name]}", tuple(lines)))
    marks = [
        Mark(item.parameters["onset"].value + item.run_shift_min, item.label)
        for item in diagnosis.causes
        if "onset" in item.parameters
    ]
    return draw_panels(panels, marks)
