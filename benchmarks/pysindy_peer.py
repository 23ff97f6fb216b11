"""Side by side with pysindy: the same records with something hidden in them; held-out error, and is the physics named?

PySINDy (Kaptanoglu et al. 2022, J. Open Source Software 7(69)) gets the task as its authors set it for a model that is
known but lacks something (Kaheman, Kaiser, Strom, Kutz & Brunton 2019, Learning discrepancy models from experimental
data): the derivatives of the smoothed measurements minus those of the nominal equations are to be a sparse combination
of monomials of C, T and qc up to the second degree. Smoothing and threshold are those whose model runs best freely over
the rows that are learned from. Both sides see the same rows and are measured by free run on the same rows held out.

    python benchmarks/pysindy_peer.py [--records N] [--nominal N] [--seed N] [--json FILE]

pysindy is no dependency of this project (`pip install --group peers`); without it the benchmark says so and ends.
"""

import argparse
import json
import warnings
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.signal import savgol_filter

from benchmarks.hidden.classes import draw_record, find_class
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.holdout import holdout_rows
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import SimulationError, Simulator
from tests.hidden_effect.draw import Hidden
from tests.hidden_effect.judge import judge

Array = NDArray[np.float64]

SEED, RECORDS, NOMINAL_RECORDS = 20_000_000, 13, 3
THRESHOLDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 5.0)
"""Thresholds in scaled units; the last leaves no term, which is the nominal model."""

WINDOWS = (5, 9, 15)
"""Rows that are smoothed over, by a cubic."""

CENTRE, SCALE = (0.1, 438.5, 100.0), (0.03, 6.0, 6.0)
"""Centre and scale of C, T and qc, which bring all of them to the order of one."""

FIRST_ROW = 100
"""First row of simulations; the initial state has no effect by the first row held out, ten minutes later."""


@dataclass(frozen=True)
class Compared:
    """Errors of both methods on one record."""

    seed: int  # seed of the record
    truth: str  # hidden causes
    before: float  # error of the simulation of the nominal model on rows held out, over the true noise
    extended: float  # error of the extended model, over the noise
    pysindy: float  # error of the model that pysindy found, over the noise
    said: str  # cause named by the diagnosis
    terms: tuple[int, int]  # number of terms that pysindy added to the balances of C and of T


def main() -> None:
    """Run the benchmark and print it."""
    chosen = arguments()
    console = Console(width=150)
    if find_spec("pysindy") is None:
        console.print("skipped: pysindy is not installed (pip install --group peers)")
        return
    medium, nominal = find_class("medium"), find_class("nominal")
    records = [draw_record(medium, number, chosen.seed) for number in range(chosen.records)]
    # Every eleventh nominal record is one as of the class `medium`.
    records += [draw_record(nominal, 11 * number, chosen.seed) for number in range(chosen.nominal)]
    found = [compare(hidden) for hidden in records]
    table = Table(title="Free run on rows held out over the noise, the larger of C and T", title_justify="left")
    for heading in ("seed", "hidden", "nominal model", "extended model", "pysindy", "named", "terms in C, T"):
        table.add_column(heading)
    for item in found:
        numbers = [f"{value:.3f}" for value in (item.before, item.extended, item.pysindy)]
        table.add_row(str(item.seed), item.truth, *numbers, item.said, f"{item.terms[0]}, {item.terms[1]}")
    console.print(table)
    wrong = [item for item in found if item.truth != "nothing"]
    for title, part in (("something hidden", wrong), ("nothing hidden", [item for item in found if item not in wrong])):
        if part:
            medians = [np.median([getattr(item, name) for item in part]) for name in ("before", "extended", "pysindy")]
            console.print(
                f"{title}, median: nominal {medians[0]:.3f}, extended {medians[1]:.3f}, pysindy {medians[2]:.3f}; "
                f"terms {np.median([sum(item.terms) for item in part]):.0f}"
            )
    if chosen.json is not None:
        chosen.json.write_text(json.dumps([asdict(item) for item in found], indent=1) + "\n")


def compare(hidden: Hidden) -> Compared:
    """Run both methods on one record."""
    run = make_run(hidden.record, cstr())
    said = diagnose(hidden.record, cstr())
    noise_sd = np.array(hidden.circumstances.noise_sd)
    held_out = [said.gain.held_out[name] for name in ("C", "T")]
    discrepancy, terms = sparse_discrepancy(run, noise_sd)
    rows = holdout_rows(run)
    return Compared(
        hidden.seed,
        "+".join(hidden.causes) or "nothing",
        max(item.rmse_before / sd for item, sd in zip(held_out, noise_sd, strict=True)),
        max(item.rmse_after / sd for item, sd in zip(held_out, noise_sd, strict=True)),
        free_error(discrepancy, run, rows, noise_sd),
        judge(hidden, said, 0.0).called,
        terms,
    )


def sparse_discrepancy(run: Run, noise_sd: Array) -> tuple[ProcessModel, tuple[int, int]]:
    """The nominal model with what pysindy adds to it, and how many terms that are in each balance."""
    learned = np.logical_not(holdout_rows(run))
    best, best_error, terms = cstr(), inf, (0, 0)
    for window in WINDOWS:
        for threshold in THRESHOLDS:
            coefficients, powers = fit_pysindy(run, learned, window, threshold)
            model = with_monomials(cstr(), coefficients, powers)
            error = free_error(model, run, learned, noise_sd)
            if error < best_error:
                counts = np.count_nonzero(coefficients, axis=1)
                best, best_error, terms = model, error, (int(counts[0]), int(counts[1]))
    return best, terms


def fit_pysindy(run: Run, learned: NDArray[Any], window: int, threshold: float) -> tuple[Array, Array]:
    """Fit pysindy; returns coefficients, shape (2, monomials), and powers of the monomials, shape (monomials, 3)."""
    import pysindy  # it may not be there

    period = float(np.median(np.diff(run.time_min)))
    states = savgol_filter(run.measured, window, 3, axis=0)
    slopes = savgol_filter(run.measured, window, 3, deriv=1, delta=period, axis=0)
    # What is smoothed is compared with what is smoothed alike, or every step of the input would be a discrepancy.
    known = savgol_filter(nominal_rates(states, run.inputs), window, 3, axis=0)
    missing = (slopes - known) / np.array(SCALE[:2])
    scaled = (np.column_stack([states, run.inputs]) - np.array(CENTRE)) / np.array(SCALE)
    edges = np.flatnonzero(np.diff(learned.astype(int))) + 1
    stretches = [part for part in np.split(np.arange(learned.size), edges) if learned[part[0]]]
    library = pysindy.PolynomialLibrary(degree=2)
    model: Any = pysindy.SINDy(optimizer=pysindy.STLSQ(threshold=threshold), feature_library=library)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns where it leaves no term at all, which is an answer
        model.fit(
            [scaled[part, :2] for part in stretches],
            t=period,
            x_dot=[missing[part] for part in stretches],
            u=[scaled[part, 2:] for part in stretches],
        )
    return np.asarray(model.coefficients()), np.asarray(library.powers_)


def nominal_rates(states: Array, inputs: Array) -> Array:
    """The derivatives of the nominal model at some rows, shape (rows, 2)."""
    model = cstr()
    values = np.array([item.value for item in model.parameters])
    found = model.function().map(states.shape[0])(
        states.T, inputs.T, np.tile(values[:, None], states.shape[0]), np.zeros(states.shape[0]), 0.0
    )
    return np.array(found[0]).T


def with_monomials(model: ProcessModel, coefficients: Array, powers: Array) -> ProcessModel:
    """The model with sums of monomials added to its balances."""
    symbols = [item.symbol for item in (*model.states, *model.inputs)]
    z = [(symbol - centre) / scale for symbol, centre, scale in zip(symbols, CENTRE, SCALE, strict=True)]
    rates = []
    for rate, scale, row in zip(model.rhs, SCALE, coefficients, strict=False):
        added = ca.SX(0)
        for number, power in zip(row, powers, strict=True):
            added += scale * number * z[0] ** power[0] * z[1] ** power[1] * z[2] ** power[2]
        rates.append(rate + added)
    return replace(model, rhs=tuple(rates))


def free_error(model: ProcessModel, run: Run, rows: NDArray[Any], noise_sd: Array) -> float:
    """Root mean square error of a free run on some rows over the noise, the larger of C and T."""
    start = savgol_filter(run.measured[: FIRST_ROW + 20], 15, 3, axis=0)[FIRST_ROW]
    try:
        found = Simulator(model).run(run.time_min[FIRST_ROW:], run.inputs[FIRST_ROW:], start).outputs
    except SimulationError:
        return inf
    off = (run.measured[FIRST_ROW:] - found)[rows[FIRST_ROW:]] / noise_sd
    error = float(np.sqrt(np.mean(off**2, axis=0)).max())
    return error if np.isfinite(error) else inf


def arguments() -> argparse.Namespace:
    """Arguments of the command line."""
    parser = argparse.ArgumentParser(description="The diagnosis beside pysindy.")
    parser.add_argument("--records", type=int, default=RECORDS, help="with something hidden")
    parser.add_argument("--nominal", type=int, default=NOMINAL_RECORDS, help="with nothing hidden")
    parser.add_argument("--seed", type=int, default=SEED, help="the first")
    parser.add_argument("--json", type=Path, help="where the numbers are written, record by record")
    return parser.parse_args()


if __name__ == "__main__":
    main()
