"""The practical test that the report proposes: its scheme and the monitor on records of others, with faults added.

The records are DaISy's reactor, the normal record of the three tanks and the temperature lab TCLab, where they are in a
folder. A fault is added to a measured record in a stated way: from `ONSET` of its rows on the first output reads higher
by `BIAS` of the range that it has in the training, or by as much growing from zero to the end.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

import reactorwatch as rw
from benchmarks.outside.reactors_and_tanks import describe_rig
from benchmarks.study_figures.report_scheme import chart_output
from benchmarks.study_figures.study import (
    BLACK,
    BLUE,
    ORANGE,
    VERMILION,
    Figure,
    Finding,
    Study,
    Verdict,
    label,
    legend_below,
    panels,
)
from reactorwatch.arrays import Array
from reactorwatch.description.read import find_process

ONSET, BIAS = 0.6, 0.1
TITLE = "Measured records with added faults"

_LAB = 'name = "lab"\n[time]\ncolumn = "Time (sec)"\nunit = "s"\n' + "".join(
    f'[[signals]]\nname = "{name}"\ncolumn = "{column}"\nrole = "{role}"\n'
    for name, column, role in (
        ("Q1", "Heater 1 (%)", "input"),
        ("Q2", "Heater 2 (%)", "input"),
        ("T1", "Temperature 1 (degC)", "output"),
        ("T2", "Temperature 2 (degC)", "output"),
    )
)


@dataclass(frozen=True)
class Source:
    """A record of others."""

    name: str  # name in the table
    path: str  # path in the folder
    process: str  # description of the process as TOML; empty: the reactor
    training_rows: int  # rows that both learn from


SOURCES = (
    Source("DaISy reactor", "daisy_cstr.csv", "", 1000),
    Source("three tanks, normal", "three_tanks/normal.csv", describe_rig(), 1000),
    Source("TCLab", "tclab/tclab.csv", _LAB, 200),
)
FAULTS: dict[str, Callable[[Array], Array]] = {
    "none": lambda share: np.zeros_like(share),
    "step": lambda share: (share >= 0.0).astype(np.float64),
    "drift": lambda share: np.clip(share, 0.0, 1.0),
}
"""Shape of a fault over the share of the rows after its onset."""


def measured_figure(folder: Path) -> Figure:
    """The entry of the measured records in a folder."""
    return Figure(
        "section-measured",
        TITLE,
        "A practical test of the model would improve the diagnosis, which the report leaves to further work.",
        lambda study, drawing: _draw(study, drawing, folder),
        height_px=620,
    )


def _draw(_study: Study, drawing: Drawing, folder: Path) -> Finding:
    found = [source for source in SOURCES if (folder / source.path).exists()]
    if not found:
        return Finding(f"None of the records is in the folder: {', '.join(source.path for source in SOURCES)}.")
    axes = panels(drawing, len(found), 1)
    rows = []
    for one, source in zip(axes, found, strict=True):
        record, process = _read(folder, source)
        onset = round(ONSET * record.rows)
        for name, shape in FAULTS.items():
            faulty = _add(record, process.outputs[0], shape, source.training_rows, onset)
            tried = _compare(source, process, faulty, onset, is_faulty=name != "none")
            rows.append(f"| {source.name} | {name} | {tried.row} |")
            if name == "step":
                _plot(one, source, process, faulty, tried)
    legend_below(drawing, axes[0], 3)
    text = (
        f"Run on {datetime.now(UTC):%Y-%m-%d} on records of others. A fault is added to the record: from "
        f"{100 * ONSET:g} % of its rows on the first output reads higher by {100 * BIAS:g} % of its range in the "
        "training, at once (step) or growing until the end (drift). Delays are from the onset.\n\n"
        "| record | fault | report: false points | report: first point out | monitor: reference | monitor: false "
        "alarms "
        "| monitor: first alarm | monitor: cause |\n|---|---|---|---|---|---|---|---|\n" + "\n".join(rows)
    )
    return Finding(text, Verdict.NO_CLAIM)


@dataclass(frozen=True, eq=False)
class Comparison:
    """The report's scheme and the monitor on one record."""

    out_min: Array  # times of the rows that are out by the report's scheme, any output
    alarms_min: Array  # times of the monitor's alarms
    row: str  # cells of the table


def _read(folder: Path, source: Source) -> tuple[rw.Record, rw.Process]:
    if not source.process:
        process = find_process()
    else:
        with tempfile.TemporaryDirectory() as temporary:
            description = Path(temporary) / "process.toml"
            description.write_text(source.process, encoding="utf-8")
            process = find_process(description)
    return rw.read_record(folder / source.path, process=process), process


def _compare(source: Source, process: rw.Process, record: rw.Record, onset: int, *, is_faulty: bool) -> Comparison:
    time_min, onset_min = record.time_min, float(record.time_min[onset])
    u = np.column_stack([record.columns[name] for name in process.inputs])
    out = np.zeros(record.rows, dtype=bool)
    for output in process.outputs:
        out |= chart_output(u, record.columns[output], time_min, source.training_rows).out
    out[: source.training_rows] = False
    result = rw.backtest(record, training_rows=source.training_rows)
    alarms = np.array([item.raised_min for item in result.alarms])
    before = onset_min if is_faulty else np.inf
    true = [item for item in result.alarms if item.raised_min >= before]
    cause = (
        f"{true[0].suspect[0].cause} ({100 * true[0].suspect[0].probability:.0f} %)" if true and true[0].suspect else ""
    )
    cells = (
        str(int(np.sum(out & (time_min < before)))),
        _delay(time_min[out], onset_min) if is_faulty else "",
        result.reference or "none",
        str(int(np.sum(alarms < before))),
        _delay(alarms, onset_min) if is_faulty else "",
        cause,
    )
    return Comparison(time_min[out], alarms, " | ".join(cells))


def _delay(times_min: Array, onset_min: float) -> str:
    later = times_min[times_min >= onset_min]
    return f"{later.min() - onset_min:.2f} min" if later.size else "not seen"


def _plot(axes: Axes, source: Source, process: rw.Process, record: rw.Record, tried: Comparison) -> None:
    output, low = process.outputs[0], float(np.nanmin(record.columns[process.outputs[0]]))
    axes.plot(record.time_min, record.columns[output], color=BLUE, linewidth=0.7, label="first output, with the step")
    axes.plot(tried.out_min, np.full(tried.out_min.size, low), "|", color=ORANGE, label="report: a point is out")
    axes.plot(tried.alarms_min, np.full(tried.alarms_min.size, low), "v", color=VERMILION, label="monitor: an alarm")
    axes.axvline(record.time_min[round(ONSET * record.rows)], color=BLACK, linewidth=1, linestyle="--")
    label(axes, "time, min", output, source.name)


def _add(record: rw.Record, output: str, shape: Callable[[Array], Array], training_rows: int, onset: int) -> rw.Record:
    share = (np.arange(record.rows) - onset) / (record.rows - onset)
    values = record.columns[output]
    size = BIAS * float(np.ptp(values[:training_rows][np.isfinite(values[:training_rows])]))
    return replace(record, columns={**record.columns, output: values + size * shape(share)})
