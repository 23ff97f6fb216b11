"""A diagnosis as views of a dashboard: measurements and both simulations on one timeline."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.report.pictures import interval
from reactorwatch.diagnosis.result import SD_95, Curves, Diagnosis
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record, to_time_ns
from recorder.panels.base import ALARM, INPUT, LIMIT, MEASURED, PREDICTED, Colour, Series, TimePlot
from recorder.view.file import DIAGNOSIS, write_views


def write_drawing(diagnosis: Diagnosis, model: ProcessModel, measured: Record, path: Path) -> None:
    """Write a Rerun file.

    Args:
        diagnosis: the diagnosis with its curves.
        model: the diagnosed model.
        measured: the record.
        path: path of the file.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    curves = diagnosis.curves
    assert curves is not None
    time_ns = np.array([to_time_ns(minutes, measured.zero_ns) for minutes in curves.time_min.tolist()], dtype=np.int64)
    write_views({DIAGNOSIS: [*_plots(diagnosis, curves, model, time_ns)]}, path, int(time_ns[0]))


def _plots(diagnosis: Diagnosis, curves: Curves, model: ProcessModel, time_ns: NDArray[np.int64]) -> Iterator[TimePlot]:
    """Outputs, their residuals, sizes of the causes, and inputs."""

    def line(label: str, values: Array, colour: Colour, legend: str = "", width: float = 1.0) -> Series:
        return Series(label, time_ns, values, colour, width=width, legend=legend)

    for item in model.outputs:
        measured = line("measured", curves.measured[item.name], MEASURED, width=2.5)
        before = line("simulation as it was", curves.simulated_before[item.name], ALARM)
        after = line("simulation extended", curves.simulated_after[item.name], PREDICTED)
        yield TimePlot(item.name, item.unit, (measured, before, after))
    ends = np.full(time_ns.size, SD_95)
    for item in model.outputs:
        limits = (
            line(f"{end} limit", sign * ends, LIMIT, "95 % of noise") for end, sign in (("upper", 1), ("lower", -1))
        )
        before = line("as it was", curves.residual_before[item.name], ALARM)
        after = line("extended", curves.residual_after[item.name], PREDICTED)
        yield TimePlot(f"Residual of {item.name}", "standard deviations", (*limits, before, after))
    for cause in diagnosis.causes:
        lower, upper = interval(cause, curves)
        series = (
            line("upper end", upper, LIMIT, "95 % interval"),
            line("lower end", lower, LIMIT, "95 % interval"),
            Series("most likely", time_ns, curves.deviation[cause.cause], PREDICTED),
        )
        unit = cause.parameters["size"].unit
        yield TimePlot(f"Size of: {cause.label}", unit if unit != "1" else "", series)
    for given in model.inputs:
        held = Series(given.name, time_ns, curves.inputs[given.name], INPUT, held=True)
        yield TimePlot(f"{given.meaning} {given.name}", given.unit, (held,))
