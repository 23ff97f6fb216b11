"""SKAB: a real water circuit with 8 sensors, a row a second, with labelled anomalies and change points.

Protocol: the first 400 rows of a file are learned from, the rest is judged. Anomalies are scored row by row over all
files (false and missed alarms), change points by the standard profile of the Numenta benchmark, in windows of 60 s from
the change on. Data: waico/SKAB.
"""

import csv
import tempfile
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from benchmarks.outside.peers import Array, Pca
from benchmarks.outside.scores import (
    Flags,
    Row,
    WatchedRows,
    backtest,
    bootstrap_interval,
    compare_rows,
    score_change_points,
)

TRAINING = 400
WINDOW_S = 60.0
LEVEL = 0.999
RECORDS = "Over all records of the folder; the intervals are over records."
_LABELS = ("anomaly", "changepoint")


@dataclass(frozen=True, eq=False)
class File:
    """A file of the benchmark."""

    time_s: Array  # time of each row since the first, shape (rows,)
    values: Array  # shape (rows, sensors)
    sensors: tuple[str, ...]  # names of the sensors
    anomaly: Flags  # flags of the anomalous rows
    changes: Flags  # flags of the rows at which something changes


def read(path: Path) -> File:
    """Read a file."""
    with path.open(encoding="utf-8", newline="") as lines:
        rows = list(csv.DictReader(lines, delimiter=";"))
    sensors = tuple(name for name in rows[0] if name not in ("datetime", *_LABELS))
    times = [datetime.fromisoformat(row["datetime"]) for row in rows]
    anomaly, changes = (np.array([float(row[name]) > 0 for row in rows]) for name in _LABELS)
    return File(
        np.array([(time - times[0]).total_seconds() for time in times]),
        np.array([[float(row[name]) for name in sensors] for row in rows]),
        sensors,
        anomaly,
        changes,
    )


def measure(folder: Path, seed: int) -> list[Row]:
    """Rows of the table, one for each method."""
    paths = sorted(folder.glob("*.csv"))
    files = [read(path) for path in paths]
    watched = _monitor(paths, files[0].sensors)
    every = [WatchedRows(np.ones(item.anomaly.size, bool), np.zeros(item.anomaly.size, bool)) for item in files]
    return [
        _score("reactorwatch", f"backtest --training-rows {TRAINING}, no settings", files, watched, seed),
        _score("T2 + Q", f"PCA, {LEVEL:g} textbook limits", files, [_t2_and_q(item) for item in files], seed),
        _score("an alarm in every row", "no method", files, every, seed),
    ]


def _monitor(paths: list[Path], sensors: tuple[str, ...]) -> list[WatchedRows]:
    with tempfile.TemporaryDirectory() as temporary:
        outputs = [option for name in sensors for option in ("--output", name)]
        columns = ("--time", "datetime", *outputs, "--training-rows", str(TRAINING))
        return backtest(paths, Path(temporary), *columns)[0]


def _t2_and_q(file: File) -> WatchedRows:
    """PCA of the training with textbook limits; a change is where the alarm begins."""
    model = Pca.fit(file.values[:TRAINING])
    limits = model.textbook_limits(LEVEL)
    out = np.zeros(file.anomaly.size, dtype=bool)
    for name, values in model.statistics(file.values).items():
        out |= values > limits.get(name, np.inf)
    out[:TRAINING] = False
    return WatchedRows(out, out & ~np.concatenate([[False], out[:-1]]))


def _score(method: str, settings: str, files: list[File], watched: list[WatchedRows], seed: int) -> Row:
    labels = [item.anomaly[TRAINING:] for item in files]
    alarms = [item.in_alarm[TRAINING:] for item in watched]
    rows = compare_rows(labels, alarms)
    changes = score_change_points(
        [item.time_s[TRAINING:][item.changes[TRAINING:]] for item in files],
        [item.time_s[TRAINING:][seen.raised[TRAINING:]] for item, seen in zip(files, watched, strict=True)],
        WINDOW_S,
    )
    rng = np.random.default_rng(seed)
    each = [compare_rows([label], [alarm]) for label, alarm in zip(labels, alarms, strict=True)]
    false = bootstrap_interval(np.array([item.false_alarm_percent for item in each]), rng)
    missed = bootstrap_interval(np.array([item.missed_percent for item in each]), rng)
    cells = {
        "false alarms (FAR)": f"{rows.false_alarm_percent:.1f} %",
        "95 % over files": f"{false[0]:.1f} to {false[1]:.1f} %",
        "missed (MAR)": f"{rows.missed_percent:.1f} %",
        "95 % over the files": f"{missed[0]:.1f} to {missed[1]:.1f} %",
        "F1": f"{rows.f1:.2f}",
        "NAB, standard": f"{changes.score:.1f}",
        "false positives": str(changes.false_positives),
        "changes missed": str(changes.missed),
    }
    return Row(method, settings, cells)
