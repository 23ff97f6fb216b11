"""Runs of the command on files of a benchmark, as any user can run them, their scores, and tables of scores."""

import csv
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError


@dataclass(frozen=True, eq=False)
class WatchedRows:
    """Rows of a file that was watched."""

    in_alarm: NDArray[np.bool_]  # flags of the rows in alarm, shape (rows,)
    raised: NDArray[np.bool_]  # flags of the rows at which an alarm is raised


def backtest(files: Sequence[Path], folder: Path, *options: str) -> tuple[list[WatchedRows], list[dict[str, Any]]]:
    """Run `reactorwatch backtest` with `--rows` and `--json`."""
    out = folder / "rows.csv"
    command = ("backtest", *map(str, files), "--rows", str(out), "--json", "--force", *options)
    objects = [json.loads(line) for line in run(*command).splitlines() if line.startswith("{")]
    flags: dict[str, list[tuple[bool, bool]]] = {str(file): [] for file in files}
    with out.open(encoding="utf-8", newline="") as rows:
        for row in csv.DictReader(rows):
            flags[row["file"]].append((row["in_alarm"] == "1", row["raised"] == "1"))
    watched = [np.array(flags[str(file)], dtype=bool).reshape(-1, 2) for file in files]
    return [WatchedRows(item[:, 0], item[:, 1]) for item in watched], objects


def run(*arguments: str) -> str:
    """Run a command of reactorwatch and return what it prints."""
    command = [str(Path(sys.executable).with_name("reactorwatch")), *arguments]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise InputError(f"reactorwatch {arguments[0]}: {done.stderr.strip().splitlines()[-1]}")
    return done.stdout


Flags = NDArray[np.bool_]

A_TRUE, A_FALSE, A_MISSED = 1.0, -0.11, -1.0
"""Standard profile of the Numenta benchmark: value of a detection at once, of a false one, and of a missed change."""


@dataclass(frozen=True)
class Outliers:
    """Comparison of rows in alarm with rows that are labelled anomalous."""

    true_alarms: int  # number of anomalous rows in alarm
    false_alarms: int  # number of sound rows in alarm
    missed: int  # number of anomalous rows without alarm
    sound: int  # number of sound rows without alarm

    @property
    def false_alarm_percent(self) -> float:
        """Share of the sound rows that are in alarm, in percent (FAR)."""
        return 100.0 * self.false_alarms / max(self.false_alarms + self.sound, 1)

    @property
    def missed_percent(self) -> float:
        """Share of the anomalous rows that are not in alarm, in percent (MAR)."""
        return 100.0 * self.missed / max(self.missed + self.true_alarms, 1)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; an alarm in every row has 0.7 on SKAB, so it says little alone."""
        return self.true_alarms / max(self.true_alarms + (self.missed + self.false_alarms) / 2, 1e-300)


def compare_rows(labelled: Sequence[Flags], in_alarm: Sequence[Flags]) -> Outliers:
    """Compare rows in alarm with labels, over all files together."""
    truth, alarm = np.concatenate(labelled), np.concatenate(in_alarm)
    return Outliers(
        int(np.sum(truth & alarm)),
        int(np.sum(~truth & alarm)),
        int(np.sum(truth & ~alarm)),
        int(np.sum(~truth & ~alarm)),
    )


@dataclass(frozen=True)
class ChangePoints:
    """Score of change points."""

    score: float  # standard profile of the Numenta benchmark: 100 is perfect, 0 is no detection at all
    missed: int  # number of changes without a detection in their window
    false_positives: int  # number of detections outside all windows


def score_change_points(
    changes: Sequence[NDArray[np.float64]], detections: Sequence[NDArray[np.float64]], window: float
) -> ChangePoints:
    """Score detections of changes, over all files together.

    The window of a change begins at the change; where two overlap, the second begins at the end of the first. The first
    detection in a window counts the more the earlier it is.
    """
    total, missed, false, count = 0.0, 0, 0, 0
    for true, found in zip(changes, detections, strict=True):
        begins, ends = true.copy(), true + window
        for i in range(1, len(true)):
            begins[i] = max(begins[i], ends[i - 1])
        inside = np.zeros(found.size, dtype=bool)
        for begin, end in zip(begins, ends, strict=True):
            within = (found >= begin) & (found <= end)
            inside |= within
            count += 1
            if not within.any():
                missed += 1
                total += A_MISSED
                continue
            share = (found[within][0] - begin) / max(end - begin, 1e-300)
            total += _value(float(share))
        false += int(np.sum(~inside))
    total += A_FALSE * false
    perfect, none = count * A_TRUE, count * A_MISSED
    return ChangePoints(100.0 * (total - none) / (perfect - none) if count else float("nan"), missed, false)


def _value(share: float) -> float:
    """Value of a detection at a share of its window: from that of one at once to that of a false one."""
    x = np.pi * (share - 0.5)
    half = 0.5 * (A_TRUE - A_FALSE)
    return float(half + A_FALSE - half * np.tanh(x) / np.tanh(np.pi / 2))


def bootstrap_interval(
    values: NDArray[np.float64], rng: np.random.Generator, resamples: int = 2000
) -> tuple[float, float]:
    """95 % interval of a mean over files or blocks, by resampling them."""
    means = values[rng.integers(0, values.size, (resamples, values.size))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def blocks_of(flags: Flags, length: int) -> NDArray[np.float64]:
    """Shares of flagged rows in blocks of a length, shape (blocks,).

    Rows that follow each other are not independent, so blocks are resampled, not rows.
    """
    count = max(flags.size // length, 1)
    return np.array([float(part.mean()) for part in np.array_split(flags, count)])


@dataclass(frozen=True)
class Row:
    """A row of a table."""

    method: str  # name of the method
    settings: str  # settings that it was run with
    cells: dict[str, str] = field(default_factory=dict)  # values by the name of their column


def markdown(rows: Sequence[Row]) -> str:
    """Rows as a Markdown table; a cell that a row does not have stays empty."""
    columns = list(dict.fromkeys(name for row in rows for name in row.cells))
    head = f"| method | settings | {' | '.join(columns)} |\n|---|---|{'---|' * len(columns)}"
    lines = [
        f"| {row.method} | {row.settings} | {' | '.join(row.cells.get(name, '') for name in columns)} |" for row in rows
    ]
    return "\n".join([head, *lines])
