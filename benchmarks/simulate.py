"""Speed of a simulation against scipy's `solve_ivp` (LSODA, rtol 1e-8), and the difference of the two.

    python benchmarks/simulate.py [rows]

The record is the plant's own random-steps scenario: a new coolant flow every minute, a row every 0.1 min. LSODA must
not step across a jump of the input, so it is restarted: at every row, which is how a held input is most simply
written down and right for any record; and, for comparison, only where the input changes, which is the least that
this record needs. Goal: 80 times faster than the first, at most 1e-6 mol/l and 1e-3 K from both.
"""

import math
import sys
import time
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from benchmarks.harness.timing import fastest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.arrays import Array
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator

REPEATS = 9


def main(rows: int) -> None:
    """Print the table."""
    record = simulate_record(PlantConfig(noise_sd={"C": 0.0, "T": 0.0}), rows)
    times, flows = record.time_min, record.columns["qc"]
    start = np.array([record.columns["C"][0], record.columns["T"][0]])
    simulator = Simulator(cstr())
    ours_s, trajectory = fastest(lambda: simulator.run(times, flows, start), REPEATS)
    print(f"{rows} rows")
    print(f"  simulation                          {ours_s * 1e3:8.1f} ms")
    changes = np.append(np.flatnonzero(np.diff(flows, prepend=np.nan)), rows - 1)
    for where, edges in (("at every row", np.arange(rows)), ("where qc changes", np.unique(changes))):
        began = time.perf_counter()
        states = lsoda(times, flows, start, edges)
        theirs_s = time.perf_counter() - began
        C, T = np.max(np.abs(states - trajectory.states), axis=0)
        print(f"  LSODA, restarted {where:<19}{theirs_s * 1e3:8.1f} ms", end="")
        print(f"  {theirs_s / ours_s:5.0f} times the simulation; at most {C:.1e} mol/l and {T:.1e} K apart")


def lsoda(times: Array, flows: Array, start: Array, edges: NDArray[np.int64]) -> Array:
    """States of every row, shape (rows, 2), restarted at each row of `edges`."""
    states = [start]
    for first, last in pairwise(edges.tolist()):
        run = solve_ivp(
            reactor,
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


def reactor(_time_min: float, state: Array, coolant_flow: float) -> tuple[float, float]:
    """The equations a second time, as quick as Python has them."""
    C, T = state.tolist()
    rate = C * math.exp(-1e4 / T)
    cooling = 0.01 * coolant_flow * (1 - math.exp(-700 / coolant_flow))
    return 1 - C - 7.2e10 * rate, 350 - T + 1.44e13 * rate + cooling * (350 - T)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 7500)
