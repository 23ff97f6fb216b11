"""False alarms without equations beside the number promised, and medium faults with equations and without.

False alarms: 100 minutes of training, then 1,400, under four kinds of inputs, at four levels of noise. Nothing of the
reactor is given but the names of its signals. Faults: with equations the plant is exactly the model, and the promise is
the default, one false alarm in 30 days.

    python -m benchmarks.promise --only black-box [--seeds N] [--noise medium,high] [--inputs moves]
"""

from collections.abc import Iterable, Sequence
from math import inf, isfinite
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from benchmarks.faults.detectors import intervals_of, outcome_of
from benchmarks.harness.bank import AFTER_MIN, Case, cases, record_of
from benchmarks.harness.plants import FLOWS, NOISE_SD, messages_of, sound_record, without_equations
from benchmarks.harness.study import Pool, head, line, median_interval, percent, poisson_interval
from monitor_node.config import MonitorConfig, ReferenceName
from monitor_node.core import Monitor
from monitor_node.learn.black_box_reference import BlackBoxMemory
from monitor_node.replay import backtest
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.records.record import to_minutes

SPAN_MIN, SEED = 1500.0, 100
"""Length of a record; the seeds below `SEED` were used for the design of the black box."""


class Job(NamedTuple):
    """A record to watch."""

    noise: str
    inputs: str
    seed: int
    reference: ReferenceName = "auto"


class Result(NamedTuple):
    """Result of a record."""

    alarms: int  # number of alarms
    expected: float  # number of false alarms promised
    rows: int  # number of rows after the training
    judged: int  # number of these that were judged
    can_keep: float  # number of false alarms that the monitor states instead
    kept: bool  # false if the monitor says that the promise is not kept


def watch(job: Job) -> Result:
    """Watch a record."""
    config = without_equations(job.reference)
    monitor, alarms = Monitor(config, 0, points=False), 0
    for message in messages_of(sound_record(job.inputs, job.noise, job.seed, SPAN_MIN)):
        publications = monitor.on_message(message, 0)
        alarms += sum(isinstance(item.message, Alarm) and item.message.event == "raised" for item in publications)
    rows, promise = monitor.pipeline.evaluation.memory.rows_watched, monitor.promise
    kept, expected = promise is None or promise.kept, monitor.pipeline.baselines.expected_false_alarms
    excess = 1.0 if promise is None else promise.can_keep_per_30_days / promise.expected
    return Result(alarms, expected, rows, rows - unfamiliar_rows(monitor), expected * excess, kept)


def unfamiliar_rows(monitor: Monitor) -> int:
    """Number of rows for which a black box knew too little of the point of operation; 0 with another reference."""
    reference = monitor.pipeline.evaluation.reference
    memory = None if reference is None else reference.memory
    return memory.unfamiliar_rows if isinstance(memory, BlackBoxMemory) else 0


def jobs_of(seeds: int, reference: ReferenceName, noises: Sequence[str], inputs: Sequence[str]) -> list[Job]:
    """Records of some levels of noise and kinds of inputs."""
    return [
        Job(noise, kind, SEED + number, reference)
        for noise in NOISE_SD
        for kind in FLOWS
        for number in range(seeds)
        if noise in noises and kind in inputs
    ]


def print_table(pool: Pool, jobs: Sequence[Job]) -> None:
    """Watch records, and print a line for each noise and input, and one for each noise."""
    print(head("noise", "input", "false alarms", "promised", "ratio (95 %)", "not kept", "stated", "rows judged"))
    found = list(zip(jobs, pool.run("black boxes", watch, jobs), strict=True))
    for noise in dict.fromkeys(job.noise for job in jobs):
        own = [(job, result) for job, result in found if job.noise == noise]
        for inputs in dict.fromkeys(job.inputs for job, _ in own):
            print(_line(noise, inputs, [result for job, result in own if job.inputs == inputs]))
        print(_line(noise, "all", [result for _, result in own]))
        for is_kept, text in ((True, "all that are said to be kept"), (False, "all that are said not to be kept")):
            some = [result for _, result in own if result.kept == is_kept]
            if 0 < len(some) < len(own):
                print(_line(noise, text, some), flush=True)


def _line(noise: str, inputs: str, found: Iterable[Result]) -> str:
    results = list(found)
    alarms, expected = sum(item.alarms for item in results), sum(item.expected for item in results)
    low, high = (limit / expected for limit in poisson_interval(alarms))
    ratio = f"{alarms / expected:.2f} ({low:.2f} to {high:.2f})"
    broken = f"{sum(not item.kept for item in results)} of {len(results)}"
    judged = sum(item.judged for item in results) / sum(item.rows for item in results)
    stated = f"{sum(item.can_keep for item in results):.1f}"
    return line(noise, inputs, alarms, f"{expected:.2f}", ratio, broken, stated, f"{100 * judged:.1f} %")


class FaultJob(NamedTuple):
    """A case to watch."""

    case: Case
    has_equations: bool


def find_delay(job: FaultJob) -> float:
    """Minutes from the onset of a fault to its detection; inf: it is not detected."""
    config = MonitorConfig(isolation=False) if job.has_equations else without_equations()  # causes change no alarm
    config = replace(config, false_alarms_per_30_days=1.0)
    result = backtest.run(messages_of(record_of(job.case)), config)
    since = result.watching_since_ns
    intervals = intervals_of(result.alarm_messages)
    onset_min = job.case.onset_min
    return outcome_of(
        intervals, inf if since is None else to_minutes(since), onset_min, onset_min + AFTER_MIN
    ).delay_min


def print_faults(pool: Pool, seeds: int) -> None:
    """Watch the medium faults of the bank, and print the shares found and the median delays."""
    medium = [case for case in cases(seeds) if case.grade == "medium"]
    jobs = [FaultJob(case, has_equations) for has_equations in (True, False) for case in medium]
    found = list(zip(jobs, pool.run("medium faults", find_delay, jobs), strict=True))
    print(head("medium faults", "runs", "found (95 %)", "median delay (95 %), min"))
    groups = {
        f"{profile}s, {'with' if has_equations else 'without'} equations": [
            delay for job, delay in found if job.has_equations == has_equations and job.case.fault.profile == profile
        ]
        for has_equations in (True, False)
        for profile in ("step", "ramp")
    } | {"all, with equations": [delay for job, delay in found if job.has_equations]}
    for name, delays in groups.items():
        least, most = median_interval(delays)
        median = f"{np.median(delays):.2f} ({least:.2f} to {most:.2f})"
        print(line(name, len(delays), percent(sum(map(isfinite, delays)), len(delays)), median))
    late = np.median(groups["steps, without equations"]) / np.median(groups["steps, with equations"])
    print(f"\nWithout equations steps are found {late:.2f} times as late.", flush=True)
