"""Medium faults of the bank (`benchmarks/faults/bank.py`), with equations and without them.

    python -m benchmarks.promise.faults [--seeds N]

With equations the plant is exactly the model. The promise is the default, one false alarm in 30 days.
"""

import argparse
from collections.abc import Sequence
from math import inf, isfinite
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from benchmarks.faults.bank import AFTER_MIN, Case, cases
from benchmarks.faults.runs import record_of
from benchmarks.faults.score import outcome_of
from benchmarks.faults.watch import intervals_of
from benchmarks.promise.black_box import without_equations
from benchmarks.promise.pool import median_interval, run_jobs, share_interval
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from reactorwatch.contract.codec import encode
from reactorwatch.records.record import to_minutes
from reactorwatch.runtime.executors import choose_executor
from reactorwatch.runtime.jobs import Executor
from recorder.tools.player import samples_of

SEEDS, PER_30_DAYS = 3, 1.0


class Job(NamedTuple):
    """A case to watch."""

    case: Case
    has_equations: bool


def watch(job: Job) -> float:
    """Minutes from the onset of a fault to its detection; inf: it is not detected."""
    config = MonitorConfig(isolation=False) if job.has_equations else without_equations()  # causes change no alarm
    config = replace(config, false_alarms_per_30_days=PER_30_DAYS)
    result = backtest.run([encode(item) for item in samples_of(record_of(job.case), config.plant)], config)
    since = result.watching_since_ns
    intervals = intervals_of(result.alarm_messages)
    onset_min = job.case.onset_min
    return outcome_of(
        intervals, inf if since is None else to_minutes(since), onset_min, onset_min + AFTER_MIN
    ).delay_min


def print_table(executor: Executor, seeds: int) -> None:
    """Watch the cases, and print the shares found and the median delays."""
    medium = [case for case in cases(seeds) if case.grade == "medium"]
    jobs = [Job(case, has_equations) for has_equations in (True, False) for case in medium]
    found = list(zip(jobs, run_jobs(executor, watch, jobs), strict=True))
    print("| medium faults | runs | found (95 %) | median delay (95 %), min |\n|---|---|---|---|")
    medians = []
    for has_equations in (True, False):
        for profile in ("step", "ramp"):
            delays = [
                delay
                for job, delay in found
                if job.has_equations == has_equations and job.case.fault.profile == profile
            ]
            name = f"{profile}s, {'with' if has_equations else 'without'} equations"
            print(_line(name, delays))
            medians.append(float(np.median(delays)))
    print(_line("all, with equations", [delay for job, delay in found if job.has_equations]))
    print(f"\nWithout equations steps are found {medians[2] / medians[0]:.2f} times as late.", flush=True)


def _line(name: str, delays: Sequence[float]) -> str:
    seen = sum(map(isfinite, delays))
    low, high = share_interval(seen, len(delays))
    least, most = median_interval(delays)
    share = f"{100 * seen / len(delays):.0f} % ({100 * low:.0f} to {100 * high:.0f})"
    return f"| {name} | {len(delays)} | {share} | {np.median(delays):.2f} ({least:.2f} to {most:.2f}) |"


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--processes", type=int, help="processes (default: one a core)")
    chosen = parser.parse_args()
    print_table(choose_executor(chosen.processes), chosen.seeds)


if __name__ == "__main__":
    main()
