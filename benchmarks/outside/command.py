"""Runs of the command on files of a benchmark, as any user can run them."""

import csv
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
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
