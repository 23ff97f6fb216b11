"""A diagnosis as views of a dashboard: measurements and both simulations on one timeline."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reactorwatch.diagnosis.report.pictures import interval
from reactorwatch.diagnosis.result import SD_95, Curves, Diagnosis
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record, to_time_ns
from recorder.dashboard.file import DIAGNOSIS, write_views
from recorder.panels.base import ALARM, INPUT, LIMIT, MEASURED, PREDICTED, Series, TimePlot


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
    views = [
        *_outputs(curves, model, time_ns),
        *_residuals(curves, model, time_ns),
        *_causes(diagnosis, curves, time_ns),
    ]
    views += [
        TimePlot(
            f"{item.meaning} {item.name}",
            item.unit,
            (Series(item.name, time_ns, curves.inputs[item.name], INPUT, held=True),),
        )
        for item in model.inputs
    ]
    write_views({DIAGNOSIS: views}, path, int(time_ns[0]))


def _outputs(curves: Curves, model: ProcessModel, time_ns: NDArray[np.int64]) -> list[TimePlot]:
    return [
        TimePlot(
            item.name,
            item.unit,
            (
                Series("measured", time_ns, curves.measured[item.name], MEASURED, width=2.5),
                Series("simulation as it was", time_ns, curves.simulated_before[item.name], ALARM, width=1.0),
                Series("simulation extended", time_ns, curves.simulated_after[item.name], PREDICTED, width=1.0),
            ),
        )
        for item in model.outputs
    ]


def _residuals(curves: Curves, model: ProcessModel, time_ns: NDArray[np.int64]) -> list[TimePlot]:
    ends = np.full(time_ns.size, SD_95)
    return [
        TimePlot(
            f"Residual of {item.name}",
            "standard deviations",
            (
                Series("upper limit", time_ns, ends, LIMIT, width=1.0, legend="95 % of noise"),
                Series("lower limit", time_ns, -ends, LIMIT, width=1.0, legend="95 % of noise"),
                Series("as it was", time_ns, curves.residual_before[item.name], ALARM, width=1.0),
                Series("extended", time_ns, curves.residual_after[item.name], PREDICTED, width=1.0),
            ),
        )
        for item in model.outputs
    ]


def _causes(diagnosis: Diagnosis, curves: Curves, time_ns: NDArray[np.int64]) -> list[TimePlot]:
    found = []
    for cause in diagnosis.causes:
        lower, upper = interval(cause, curves)
        series = (
            Series("upper end", time_ns, upper, LIMIT, width=1.0, legend="95 % interval"),
            Series("lower end", time_ns, lower, LIMIT, width=1.0, legend="95 % interval"),
            Series("most likely", time_ns, curves.deviation[cause.cause], PREDICTED),
        )
        unit = cause.parameters["size"].unit
        found.append(TimePlot(f"Size of: {cause.label}", unit if unit != "1" else "", series))
    return found
