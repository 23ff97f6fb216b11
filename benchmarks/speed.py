"""Speeds on one core, each beside a peer in the same run: simulation, recursive least squares, tables, back-test.

    python benchmarks/speed.py [--only simulation|rls|tables|back-test] [--rows N]

Times are the fastest of several runs, as other load on the machine makes single times only longer; the first run of
each, which may compile, is not counted.

Goals: a simulation 80 times as fast as LSODA restarted at every row, and at most 1e-6 mol/l and 1e-3 K from it; an
update of recursive least squares 5 times as fast as padasip's; tables at 4 times the rate of `numpy.loadtxt`; a
back-test of at least 20,000 rows a second; a row of a black box with eight outputs in 60 microseconds.
"""

import argparse
import math
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from padasip.filters import FilterRLS
from scipy.integrate import solve_ivp

from benchmarks.harness.plants import messages_of
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import decode
from reactorwatch.description.read import find_process, read_process_table
from reactorwatch.identification.black_box_filter import BlackBoxFilter
from reactorwatch.identification.black_box_fit import fit_black_box
from reactorwatch.identification.rls import RecursiveLeastSquares
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table

Result = TypeVar("Result")

PARAMETERS, UPDATES = 7, 2000
OUTPUTS, TRAINING, WATCHED = 8, 1000, 4000


def fastest(run: Callable[[], Result], repeats: int) -> tuple[float, Result]:
    """Seconds of the fastest of some runs, after one that is not counted, and a result."""
    result, seconds = run(), []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return min(seconds), result


def simulation(rows: int = 7500) -> None:
    """Simulation against scipy's LSODA (rtol 1e-8), with a new coolant flow every minute and a row every 0.1 min.

    LSODA must not step across a jump of the input. It is restarted at every row, which is right for any record, and,
    for comparison, only where the input changes.
    """
    record = simulate_record(PlantConfig(noise_sd={"C": 0.0, "T": 0.0}), rows)
    times, flows = record.time_min, record.columns["qc"]
    start = np.array([record.columns["C"][0], record.columns["T"][0]])
    simulator = Simulator(cstr())
    ours_s, trajectory = fastest(lambda: simulator.run(times, flows, start), 9)
    print(f"simulation of {rows} rows {ours_s * 1e3:8.1f} ms")
    changes = np.append(np.flatnonzero(np.diff(flows, prepend=np.nan)), rows - 1)
    for where, edges in (("at every row", np.arange(rows)), ("where qc changes", np.unique(changes))):
        started = time.perf_counter()
        states = _lsoda(times, flows, start, edges)
        theirs_s = time.perf_counter() - started
        C, T = np.max(np.abs(states - trajectory.states), axis=0)
        print(f"  LSODA, restarted {where:<17}{theirs_s * 1e3:8.1f} ms", end="")
        print(f"  {theirs_s / ours_s:5.0f} times the simulation; at most {C:.1e} mol/l and {T:.1e} K apart")


def _lsoda(times: Array, flows: Array, start: Array, edges: NDArray[np.int64]) -> Array:
    """States of every row, shape (rows, 2), restarted at each row of `edges`."""
    states = [start]
    for first, last in pairwise(edges.tolist()):
        run = solve_ivp(
            _reactor,
            (times[first], times[last]),
            states[-1],
            "LSODA",
            t_eval=times[first : last + 1],
            args=(flows[first],),
            rtol=1e-8,
            atol=[1e-9, 1e-7],
        )
        states.extend(run.y.T[1:])
    return np.array(states)


def _reactor(_time_min: float, state: Array, coolant_flow: float) -> tuple[float, float]:
    """The equations a second time, as quick as Python has them."""
    C, T = state.tolist()
    rate = C * math.exp(-1e4 / T)
    cooling = 0.01 * coolant_flow * (1 - math.exp(-700 / coolant_flow))
    return 1 - C - 7.2e10 * rate, 350 - T + 1.44e13 * rate + cooling * (350 - T)


def rls() -> None:
    """Update of ARX(3,3) by recursive least squares against padasip's `FilterRLS.adapt` on the same rows."""
    rng = np.random.default_rng(1)
    regressors, measured = list(rng.standard_normal((UPDATES, PARAMETERS))), rng.standard_normal(UPDATES).tolist()
    for forgetting in (1.0, 0.999):
        peer, own = FilterRLS(PARAMETERS, mu=forgetting), RecursiveLeastSquares(PARAMETERS, forgetting)
        rows = list(zip(regressors, measured, strict=True))

        def adapt(peer: FilterRLS = peer, rows: list[tuple[Array, float]] = rows[:500]) -> None:
            for regressor, output in rows:
                peer.adapt(output, regressor)

        def update(own: RecursiveLeastSquares = own, rows: list[tuple[Array, float]] = rows) -> None:
            for regressor, output in rows:
                own.update(regressor, output)

        theirs, ours = 1e6 * fastest(adapt, 25)[0] / 500, 1e6 * fastest(update, 25)[0] / UPDATES
        print(f"recursive least squares, forgetting {forgetting:<5} {ours:6.3f} us an update, ", end="")
        print(f"padasip {theirs:6.3f} us: {theirs / ours:5.1f} times")


def make_record(rows: int, digits: int | None) -> Record:
    """Simulated values of the reactor's signals; `digits` after the point, None: all 17."""
    generator = np.random.default_rng(1)
    columns = {
        name: generator.normal(mean, sd, rows) for name, mean, sd in (("qc", 103, 4), ("C", 0.1, 0.01), ("T", 440, 2))
    }
    if digits is not None:
        columns = {name: np.round(values, digits) for name, values in columns.items()}
    return Record(np.arange(rows) / 10, columns, "made")


def write_tables(folder: Path, rows: int) -> list[Path]:
    """Write one record in full, short, with decimal commas, and with timestamps instead of minutes."""
    paths = full, short, german, stamps = [folder / f"{name}.csv" for name in ("full", "short", "german", "stamps")]
    record = make_record(rows, 4)
    write_table(full, make_record(rows, None))
    write_table(short, record)
    german.write_text(short.read_text().replace(",", ";").replace(".", ","))
    times = np.datetime64("2026-03-01T08:00", "ms") + np.round(record.time_min * 60_000).astype("timedelta64[ms]")
    lines = zip(times.astype(str), *(values.tolist() for values in record.columns.values()), strict=True)
    with stamps.open("w") as file:
        file.write(f"timestamp,{','.join(record.columns)}\n")
        file.writelines(f"{','.join(map(str, line))}\n" for line in lines)
    return paths


def tables(rows: int = 1_000_000, repeats: int = 5) -> None:
    """Rate of reading tables of four columns, as a multiple of `numpy.loadtxt`."""
    with TemporaryDirectory() as folder:
        full, short, *others = write_tables(Path(folder), rows)
        loads = {
            path: fastest(partial(np.loadtxt, path, delimiter=",", skiprows=1), repeats)[0] for path in (full, short)
        }
        for path in (full, short, *others):
            ours, _ = fastest(partial(read_process_table, path, find_process()), repeats)
            peer = full if path == full else short
            print(f"{rows} rows, {path.stem:8} {ours:7.3f} s  {loads[peer] / ours:5.1f} times loadtxt of {peer.stem}")


def back_test(rows: int = 50_000) -> None:
    """Rows a second of the monitor's core on a record with a leak in its last tenth, beside decoding alone.

    The end of the training, its diagnosis and each look for a cause cost a fixed time, a tenth or two of a second each.
    """
    leak = f"coolant_flow:step:-0.1@{0.09 * rows:g}min"
    messages = messages_of(simulate_record(PlantConfig(seed=1, faults=(leak,)), rows))
    kinds = {
        "back-test": MonitorConfig(),
        "without isolation": MonitorConfig(isolation=False),
        "without diagnosis": MonitorConfig(diagnose_training=False),
    }
    for name, config in kinds.items():
        seconds, result = fastest(partial(backtest.run, messages, config), 3)
        print(f"{name:20} {rows / seconds:10,.0f} rows/s, {len(result.raised_alarms)} alarms")
    seconds, _ = fastest(lambda: [decode(item.payload, item.encoding) for item in messages], 3)
    print(f"{'decoding alone':20} {rows / seconds:10,.0f} rows/s")
    print(f"{'a row of a black box':20} {_black_box_row():10.0f} us")


def _black_box_row() -> float:
    """Microseconds of processor time of a row of a black box with eight outputs, the least of four parts."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.normal(size=((TRAINING + WATCHED) // 10, 1)), 10, axis=0)
    coupling = np.diag(np.linspace(0.3, 0.9, OUTPUTS)) + 0.05 * rng.normal(size=(OUTPUTS, OUTPUTS))
    states, y = np.zeros(OUTPUTS), np.empty((len(u), OUTPUTS))
    for k, value in enumerate(u):
        y[k] = states + 0.1 * rng.normal(size=OUTPUTS)
        states = coupling @ states + value
    follows = np.arange(TRAINING) > 0
    watching = BlackBoxFilter(fit_black_box(u[:TRAINING], y[:TRAINING], follows, np.full(OUTPUTS, 1e-3)))
    watching.run(u[:TRAINING], y[:TRAINING], follows)
    times, inputs, measured = [], u[TRAINING:].tolist(), y[TRAINING:].tolist()
    for part in np.array_split(np.arange(WATCHED), 4):
        start = time.process_time()
        for k in part.tolist():
            watching.update(inputs[k], measured[k], [6.0] * OUTPUTS)
        times.append((time.process_time() - start) / part.size)
    return 1e6 * min(times)


def main() -> None:
    """Print the speeds."""
    works: dict[str, Callable[..., None]] = {
        "simulation": simulation, "rls": rls, "tables": tables, "back-test": back_test,
    }  # fmt: skip
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=works)
    parser.add_argument("--rows", type=int, help="rows of the record, but for rls")
    chosen = parser.parse_args()
    for name in [chosen.only] if chosen.only else works:
        works[name](*([chosen.rows] if chosen.rows and name != "rls" else []))


if __name__ == "__main__":
    main()
