"""False alarms without equations beside the number promised, on sound records of the reactor.

100 minutes of training, then 1,400, under four kinds of inputs and at four levels of noise. Nothing of the reactor is
given but the names of its signals.

    python -m benchmarks.promise.black_box [--seeds N] [--noise medium,high] [--inputs moves] [--reference black-box]
"""

import argparse
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.promise.pool import poisson_interval, run_jobs
from monitor_node.config import MonitorConfig, ReferenceName
from monitor_node.core import Monitor
from monitor_node.learn.black_box_reference import BlackBoxMemory
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import encode
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import start_state
from reactorwatch.records.record import Record
from reactorwatch.runtime.parallel import choose_executor
from reactorwatch.runtime.parallel.jobs import Executor
from recorder.tools.player import samples_of

PERIOD_MIN, TRAINING_MIN, SPAN_MIN, PROMISE_PER_30_DAYS = 0.1, 100.0, 1500.0, 30.0
NOISE_SD = {"none": (0.0, 0.0), "low": (0.0005, 0.05), "medium": (0.002, 0.3), "high": (0.005, 1.0)}
INPUTS = ("wide", "mid", "moves", "sines")
SEEDS, SEED = 6, 100
"""Records of each kind; the seeds below `SEED` were used for the design of the black box."""


class Job(NamedTuple):
    """A record to watch."""

    noise: str
    inputs: str
    seed: int
    reference: ReferenceName = "auto"
    span_min: float = SPAN_MIN


class Result(NamedTuple):
    """Result of a record."""

    alarms: int  # number of alarms
    expected: float  # number of false alarms promised
    rows: int  # number of rows after the training
    judged: int  # number of these that were judged
    kept: bool  # false if the monitor says that the promise is not kept


def without_equations(reference: ReferenceName = "auto") -> MonitorConfig:
    """Settings of a monitor that knows the names of the reactor's signals only."""
    return MonitorConfig(
        process="",
        inputs=("qc",),
        outputs=("C", "T"),
        reference=reference,
        training_min=TRAINING_MIN,
        false_alarms_per_30_days=PROMISE_PER_30_DAYS,
        isolation=False,
        smallest_sd={},
        priorities={},
    )


def flows_of(kind: str, rows: int, rng: np.random.Generator) -> Array:
    """Coolant flow of a record."""
    time_min = np.arange(rows) * PERIOD_MIN
    if kind == "sines":
        phases = rng.uniform(0.0, 2.0 * np.pi, 3)
        waves = zip((3.0, 3.0, 2.0), (3.1, 7.7, 19.0), phases, strict=True)
        return np.asarray(101.0 + sum(a * np.sin(2 * np.pi * time_min / period + phase) for a, period, phase in waves))
    every, low, high = {"wide": (1.0, 90, 111), "mid": (1.0, 97, 109), "moves": (75.0, 93, 109)}[kind]
    index = (time_min / every).astype(int)
    return np.asarray(rng.uniform(low, high, index[-1] + 1)[index])


def sound_record(kind: str, noise: str, seed: int, span_min: float) -> Record:
    """Record of a sound reactor."""
    rng, rows = np.random.default_rng(seed), round(span_min / PERIOD_MIN)
    time_min, flows = np.round(np.arange(rows) * PERIOD_MIN, 6), flows_of(kind, rows, rng)
    outputs = Simulator(cstr()).run(time_min, flows, start_state(cstr(), flows[:1], "operating")).outputs
    outputs = outputs + np.array(NOISE_SD[noise]) * rng.standard_normal(outputs.shape)
    return Record(time_min, {"qc": flows, "C": outputs[:, 0], "T": outputs[:, 1]}, f"{kind}, {noise} noise, {seed}")


def watch(job: Job) -> Result:
    """Watch a record."""
    config = without_equations(job.reference)
    monitor, alarms = Monitor(config, 0, points=False), 0
    for item in samples_of(sound_record(job.inputs, job.noise, job.seed, job.span_min), config.plant):
        publications = monitor.on_message(encode(item), 0)
        alarms += sum(isinstance(item.message, Alarm) and item.message.event == "raised" for item in publications)
    rows, promise = monitor.pipeline.evaluation.memory.rows_watched, monitor.promise
    kept = promise is None or promise.kept
    return Result(
        alarms,
        monitor.pipeline.baselines.expected_false_alarms,
        rows,
        rows - unfamiliar_rows(monitor),
        kept,
    )


def unfamiliar_rows(monitor: Monitor) -> int:
    """Number of rows for which a black box knew too little of the point of operation; 0 with another reference."""
    reference = monitor.pipeline.evaluation.reference
    memory = None if reference is None else reference.memory
    return memory.unfamiliar_rows if isinstance(memory, BlackBoxMemory) else 0


def print_table(executor: Executor, jobs: Sequence[Job]) -> None:
    """Watch records, and print a line for each noise and input, and one for each noise."""
    print("| noise | input | false alarms | promised | ratio (95 %) | not kept | rows judged |")
    print("|---|---|---|---|---|---|---|", flush=True)
    found = list(zip(jobs, run_jobs(executor, watch, jobs), strict=True))
    for noise in dict.fromkeys(job.noise for job in jobs):
        own = [(job, result) for job, result in found if job.noise == noise]
        for inputs in dict.fromkeys(job.inputs for job, _ in own):
            print(_line(noise, inputs, [result for job, result in own if job.inputs == inputs]))
        print(_line(noise, "all", [result for _, result in own]))
        kept = [result for _, result in own if result.kept]
        if 0 < len(kept) < len(own):
            print(_line(noise, "all that are said to be kept", kept), flush=True)


def _line(noise: str, inputs: str, results: Iterable[Result]) -> str:
    results = list(results)
    alarms, expected = sum(item.alarms for item in results), sum(item.expected for item in results)
    low, high = poisson_interval(alarms)
    judged = sum(item.judged for item in results) / sum(item.rows for item in results)
    return (
        f"| {noise} | {inputs} | {alarms} | {expected:.2f} | {alarms / expected:.2f} ({low / expected:.2f} to "
        f"{high / expected:.2f}) | {sum(not item.kept for item in results)} of {len(results)} | {100 * judged:.1f} % |"
    )


def jobs_of(seeds: int, reference: ReferenceName = "auto") -> list[Job]:
    """Records of all kinds, by noise and input."""
    return [
        Job(noise, inputs, SEED + number, reference)
        for noise in NOISE_SD
        for inputs in INPUTS
        for number in range(seeds)
    ]


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--noise", default=",".join(NOISE_SD))
    parser.add_argument("--inputs", default=",".join(INPUTS))
    parser.add_argument("--reference", choices=["auto", "black-box", "arx"], default="auto")
    parser.add_argument("--processes", type=int, help="processes (default: one a core)")
    chosen = parser.parse_args()
    noises, inputs = chosen.noise.split(","), chosen.inputs.split(",")
    jobs = [job for job in jobs_of(chosen.seeds, chosen.reference) if job.noise in noises and job.inputs in inputs]
    print_table(choose_executor(chosen.processes), jobs)


if __name__ == "__main__":
    main()
