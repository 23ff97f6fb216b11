"""Records and simulations in a notebook."""

from typing import TYPE_CHECKING

import numpy as np

from reactorwatch import html
from reactorwatch.figures import Line, Mark, Panel
from reactorwatch.optional import make_frame
from reactorwatch.records.record import Record

if TYPE_CHECKING:
    from pandas import DataFrame


def record_frame(record: Record) -> "DataFrame":
    """Rows of a record with the index `time_min`, or with the clock time if it is known."""
    columns = {"run": record.runs, **record.columns} if record.runs is not None else dict(record.columns)
    if not record.zero_ns:
        return make_frame({"time_min": record.time_min, **columns}, "time_min")
    times = record.zero_ns + np.round(record.time_min * 60e6).astype(np.int64) * 1000
    return make_frame({"time": times.astype("datetime64[ns]"), "time_min": record.time_min, **columns}, "time")


def record_html(record: Record) -> str:
    """Rows, span and remarks of a record, and the range of each signal."""
    since = f", minutes since {record.zero}" if record.zero else ""
    rows = []
    for name, values in record.columns.items():
        known = values[np.isfinite(values)]
        low, high = (f"{known.min():.6g}", f"{known.max():.6g}") if known.size else ("", "")
        rows.append((name, record.units.get(name, ""), low, high, record.rows - known.size or ""))
    return "".join(
        [
            html.headline(f"{record.name}: {record.rows} rows over {record.span_min:g} min{since}"),
            *map(html.sentence, record.remarks),
            html.table(("signal", "unit", "lowest", "highest", "missing"), rows),
        ]
    )


def signal_panels(
    record: Record,
    inputs: tuple[str, ...],
    simulated: Record | None = None,
    names: tuple[str, ...] | None = None,
    marks: tuple[Mark, ...] = (),
) -> list[Panel]:
    """A panel for each signal, outputs first, with their simulation.

    Args:
        record: the measured record.
        inputs: names of its inputs.
        simulated: simulation in the same rows; None: there is none.
        names: signals that are shown; None: all.
        marks: moments and spans in all panels.
    """
    shown = [name for name in record.columns if names is None or name in names]
    panels, x_title = [], f"min since {record.zero}" if record.zero else "min"
    for name in sorted(shown, key=lambda item: item in inputs):
        unit, is_input = record.units.get(name, ""), name in inputs
        kind, label = ("input", name) if is_input else ("after" if simulated is None else "measured", "measured")
        lines = [Line(label, record.continuous_min, record.columns[name], kind, is_input)]
        if simulated is not None and not is_input and name in simulated.columns:
            lines.append(Line("simulated", simulated.continuous_min, simulated.columns[name], "before"))
        panels.append(Panel(f"{name}, {unit}" if unit else name, tuple(lines), marks, x_title))
    return panels
