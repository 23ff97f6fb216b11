"""A record drawn with its truth, its files, and inputs that step at random."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Cause(NamedTuple):
    """The one cause in a record."""

    names: tuple[str, ...]  # names in the catalogue; several where they are the same term of the equations
    sizes: tuple[float, ...]  # sizes that are right: of the plant's constant and, where that is off, of the nominal one
    unit: str  # unit of the sizes
    onset_min: float | None  # time of the step; None: the profile has none, or it is not scored
    profile: str = "step"  # profile in time


class Drawn(NamedTuple):
    """A record and the truth about it."""

    plant: str  # name of the plant
    group: str  # class of the record, a row of the table
    seed: int  # seed of the set
    number: int  # number in the set
    process: str  # name of the process, or text of its file
    columns: Mapping[str, Array]  # columns by header, the time first
    period_min: float  # interval between rows
    cause: Cause | None  # None: a sound plant
    inexact: Mapping[str, Any]  # differences of the plant and its logger from the equations

    @property
    def truth(self) -> dict[str, Any]:
        """All but the rows and the process."""
        fields = self._asdict() | {"cause": None if self.cause is None else self.cause._asdict()}
        return {name: value for name, value in fields.items() if name not in ("process", "columns")}


def write_files(drawn: Drawn, folder: Path) -> tuple[Path, str]:
    """Write a record, its truth and its process's file into a folder; returns the record and what `--process` takes."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{'sound' if drawn.cause is None else 'record'}_{drawn.number:03d}.csv"
    rows = np.column_stack(list(drawn.columns.values()))
    np.savetxt(path, rows, "%.10g", ",", header=",".join(drawn.columns), comments="")
    path.with_suffix(".truth.json").write_text(json.dumps(drawn.truth, indent=1) + "\n", encoding="utf-8")
    if "\n" not in drawn.process:
        return path, drawn.process
    process = folder / f"{drawn.plant}.py"
    process.write_text(drawn.process, encoding="utf-8")
    return path, str(process)


def draw_moves(
    rng: np.random.Generator, end: float, hold: tuple[float, float], levels: tuple[float, float], grid: float | None
) -> tuple[Array, Array]:
    """Draw the times at which an input steps, multiples of a grid if there is one, and its level from each on."""
    times = np.cumsum(rng.uniform(*hold, int(end / hold[0]) + 1))
    times = np.concatenate([[0.0], times[times < end]])
    if grid is not None:
        times = np.round(times / grid) * grid
    return times, np.round(rng.uniform(*levels, times.size), 1)


def level_at(moves: tuple[Array, Array], times: Array | float) -> Array:
    """Levels of an input at some times; before the first move it has its first level."""
    return np.asarray(moves[1][np.maximum(np.searchsorted(moves[0], times, side="right") - 1, 0)])
