"""Output of `info` for a table: a JSON object, or lines for people."""

from pathlib import Path
from typing import Any

import numpy as np

from reactorwatch.records.record import Record
from reactorwatch.terminal import printable_lines

GAP = 1.5
"""Steps of at least so many median steps are gaps."""

MAX_LINES = 20
"""Gaps that are listed one by one for people."""


def table_object(record: Record, file: Path) -> dict[str, Any]:
    """The object that `info --json` prints for a table."""
    steps = [np.diff(run.time_min) for run in record.split_runs()]
    step_min = float(np.median(np.concatenate(steps))) if record.rows > len(steps) else None
    gaps = []
    for run, between in zip(record.split_runs(), steps, strict=True):
        rows = np.flatnonzero(between > GAP * step_min) if step_min is not None else ()
        gaps += [{"from_min": float(run.time_min[row]), "to_min": float(run.time_min[row + 1])} for row in rows]
    return {
        "file": str(file),
        "zero": record.zero,
        "read_as": record.read_as,
        "rows": record.rows,
        "runs": len(record.run_starts),
        "first_min": float(record.time_min[0]),
        "last_min": float(record.time_min[-1]),
        "period_s": None if step_min is None else step_min * 60,
        "gaps": gaps,
        "signals": {name: _signal_object(record, name) for name in record.columns},
    }


def _signal_object(record: Record, name: str) -> dict[str, Any]:
    known = record.columns[name][np.isfinite(record.columns[name])]
    return {
        "unit": record.units.get(name),
        "missing": record.rows - int(known.size),
        "lowest": float(known.min()) if known.size else None,
        "highest": float(known.max()) if known.size else None,
    }


def table_text(record: Record, file: Path) -> str:
    """Format the output of `info` for a table."""
    found = table_object(record, file)
    period = "" if found["period_s"] is None else f", one each {found['period_s']:g} s"
    since = f", minutes since {found['zero']}" if found["zero"] else ""
    lines = [f"{file}: {record.rows} rows, {found['first_min']:g} to {found['last_min']:g} min{period}{since}"]
    lines += record.remarks
    width = max((len(name) for name in record.columns), default=0)
    for name, signal in found["signals"].items():
        span = "no values" if signal["lowest"] is None else f"{signal['lowest']:g} to {signal['highest']:g}"
        missing = f", {signal['missing']} missing" if signal["missing"] else ""
        lines.append(f"  {name:{width}}  {span} {signal['unit'] or '(unit not known)'}{missing}")
    gaps = found["gaps"]
    lines += [f"gap from {gap['from_min']:g} to {gap['to_min']:g} min" for gap in gaps[:MAX_LINES]]
    lines += [f"and {len(gaps) - MAX_LINES} more gaps"] if len(gaps) > MAX_LINES else []
    return printable_lines(lines if gaps else [*lines, "no gaps"])
