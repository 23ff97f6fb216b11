"""A record drawn with its truth, files of it, and integration of its plant's equations apart from the product's."""

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cause:
    """The one cause in a record."""

    names: tuple[str, ...]  # names in the catalogue; several where they are the same term of the equations
    sizes: tuple[
        float, ...
    ]  # sizes that are right: of the plant's own constant and, where that is off, of the nominal one
    unit: str  # unit of the sizes
    onset_min: float | None = None  # time of the step; None: the profile has none, or it is not scored
    profile: str = "step"  # profile in time


@dataclass(frozen=True, eq=False)
class Drawn:
    """A record and the truth about it."""

    plant: str  # name of the plant
    group: str  # class of the record, a row of the table
    seed: int  # seed of the set
    number: int  # number in the set
    process: str  # name of the process, or text of its file
    columns: Mapping[str, Array]  # columns by header, the time first
    cause: Cause | None  # None: a sound plant
    period_min: float  # median interval between rows
    inexact: Mapping[str, Any] = field(default_factory=dict)  # how the plant and its logger differ from the equations

    @property
    def name(self) -> str:
        """Name of the files of the record."""
        return f"{'sound' if self.cause is None else 'record'}_{self.number:03d}"

    @property
    def truth(self) -> dict[str, Any]:
        """All but the rows, as the file beside the record has it."""
        cause = None if self.cause is None else vars(self.cause)
        return {
            "plant": self.plant, "class": self.group, "seed": self.seed, "number": self.number,
            "cause": cause, "period_min": self.period_min, "inexact": dict(self.inexact),
        }  # fmt: skip


def write_files(drawn: Drawn, folder: Path) -> tuple[Path, str]:
    """Write a record, its truth and its process's file into a folder; returns the record and what `--process` takes."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{drawn.name}.csv"
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(drawn.columns)
        rows.writerows([f"{value:.10g}" for value in row] for row in zip(*drawn.columns.values(), strict=True))
    path.with_suffix(".truth.json").write_text(json.dumps(drawn.truth, indent=1) + "\n", encoding="utf-8")
    if "\n" not in drawn.process:
        return path, drawn.process
    process = folder / f"{drawn.plant.replace('-', '_')}.py"
    process.write_text(drawn.process, encoding="utf-8")
    return path, str(process)


def integrate(
    rates: Callable[[float, Array], Array], start: Sequence[float] | Array, breaks: Sequence[float]
) -> Callable[[Array], Array]:
    """Integrate piecewise autonomous equations.

    Args:
        rates: function of a time and the states that returns their derivatives; between two breaks it is called with
            the time in the middle, so a right-hand side that jumps there is never evaluated at the jump.
        start: states at the first break.
        breaks: sorted times, the first and the last of the solution among them.

    Returns:
        Function of times, shape (n,), that returns the states, shape (states, n).
    """
    edges = np.unique(breaks)
    x, pieces = np.asarray(start, dtype=np.float64), []
    for begin, end in pairwise(edges.tolist()):
        done = _solve(partial(rates, 0.5 * (begin + end)), begin, end, x)
        pieces.append(done.sol)
        x = done.y[:, -1]

    def states(times: Array) -> Array:
        piece = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, len(pieces) - 1)
        return np.stack([pieces[i](t) for i, t in zip(piece.tolist(), times.tolist(), strict=True)], axis=1)

    return states


def _solve(rates: Callable[[Array], Array], begin: float, end: float, x: Array) -> Any:
    """Integrate autonomous equations."""
    done = solve_ivp(lambda _, x: rates(x), (begin, end), x, "DOP853", dense_output=True, rtol=1e-9, atol=1e-9)
    if not done.success:
        raise ArithmeticError(f"integration from {begin:g} to {end:g}: {done.message}")
    return done


def draw_moves(
    rng: np.random.Generator, end: float, hold: tuple[float, float], levels: tuple[float, float], grid: float | None
) -> tuple[Array, Array]:
    """Draw times and levels of an input that steps at random.

    Args:
        rng: source of the draws.
        end: time after which there are no moves.
        hold: shortest and longest time between two moves.
        levels: lowest and highest level.
        grid: interval of which the times are multiples; None: any times.

    Returns:
        Times of the moves, the first of them 0, and the level from each on.
    """
    times = np.cumsum(rng.uniform(*hold, int(end / hold[0]) + 1))
    times = np.concatenate([[0.0], times[times < end]])
    if grid is not None:
        times = np.round(times / grid) * grid
    return times, np.round(rng.uniform(*levels, times.size), 1)


def level_at(moves: tuple[Array, Array], times: Array | float) -> Array:
    """Levels of an input at some times; before the first move it has its first level."""
    return np.asarray(moves[1][np.maximum(np.searchsorted(moves[0], times, side="right") - 1, 0)])
