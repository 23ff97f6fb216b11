"""Suspects of the monitor on faults of the reactor.

    python benchmarks/suspects.py bank [seeds of the bank] [first seed of the steps] [processes]
    python benchmarks/suspects.py training [seeds]

- `bank`: rank of the true cause 150 minutes after the onset, in the medium faults of the bank
  (`benchmarks/harness/bank.py`), and in steps of every cause from seeds and onsets that the bank does not have, of
  medium and of half of medium size. Goals: first in 80 % of the bank's medium faults, among the first two in 92 %;
  first in 14 of 16 steps.
- `training`: a leak of 5 % of the coolant in plants that were a little off the equations from the start, judged by the
  equations as given (`diagnose_training = false`), by what the diagnosis of the training found, and live. The first
  suspect 30 minutes after the onset. Goal: `coolant_flow` with at least 0.8 in each plant. `make promise` has the false
  alarms of such plants.
"""

import sys
from itertools import product
from typing import NamedTuple

import msgspec
import numpy as np

from benchmarks.faults.detectors import newest_suspects, watch
from benchmarks.harness.bank import AFTER_MIN, BANK, Case, cases, record_of
from benchmarks.harness.plants import messages_of
from benchmarks.harness.study import Pool, share_interval
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.diagnosis_worker import find_deviations
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.messages_pb2 import Incident
from reactorwatch.records.record import Record

BUDGET_PER_30_DAYS = 30.0
EARLIEST_MIN, SPAN_MIN = 200.0, 40.0
"""Earliest onset of a step, and the width of the interval of onsets."""

TWICE = ("feed_temperature", "coolant_flow", "reaction_heat")
"""Causes of which both signs are among the sixteen steps."""

FIRST_SEED = 81_000_000


def rank(case: Case) -> int:
    """Rank of the true cause at the end of a run, from 1; 0: it is no suspect."""
    watched = watch(record_of(case), BUDGET_PER_30_DAYS)
    latest = max((message.incident for message in watched.messages), default=0)
    suspects = sorted(newest_suspects(watched, latest), key=lambda item: -item.probability)
    return next((i for i, item in enumerate(suspects, start=1) if item.cause == case.fault.cause), 0)


def fresh_steps(factor: float, first_seed: int) -> list[Case]:
    """Sixteen steps of a fraction of their medium sizes, at onsets that follow from their seeds."""
    steps = [fault for fault in BANK if fault.profile == "step"]
    found = []
    for i, fault in enumerate([*steps, *(fault for fault in steps if fault.cause in TWICE)]):
        sign = fault.signs[(i + (i >= len(steps))) % len(fault.signs)]
        onset_min = EARLIEST_MIN + SPAN_MIN * float(np.random.default_rng(first_seed + i).random())
        size = sign * factor * fault.sizes[1]
        found.append(Case(fault, "medium", size, round(onset_min, 3), first_seed + i))
    return found


def print_ranks(name: str, runs: list[Case], pool: Pool) -> None:
    """Print how often the true cause came first, and among the first two."""
    ranks, texts = pool.run(name, rank, runs), []
    for most in (1, 2):
        count = sum(0 < item <= most for item in ranks)
        low, high = share_interval(count, len(ranks))
        texts.append(f"{count} of {len(ranks)} ({low:.0%} to {high:.0%})")
    print(f"{name:<40} first {texts[0]:<24} among the first two {texts[1]}", flush=True)


def print_bank(seeds: int = 1, first_seed: int = FIRST_SEED, jobs: int | None = None) -> None:
    """Print both tables."""
    pool = Pool(jobs)
    medium = [case for case in cases(seeds) if case.grade == "medium"]
    print_ranks(f"medium faults of the bank, {AFTER_MIN:g} min", medium, pool)
    for factor in (1.0, 0.5):
        print_ranks(f"fresh steps, {factor:g} of medium", fresh_steps(factor, first_seed), pool)


CONFIG = MonitorConfig()
LEAK_MIN, LATER_MIN = 160.0, 30.0
LEAK = f"coolant_flow:step:-0.05@{LEAK_MIN:g}min"
BEFORE = {
    "nothing": (),
    "feed 1 K warmer": ("feed_temperature:constant:1",),
    "analyser 2 % high": ("concentration_gain:constant:0.02",),
    "reaction 3 % slower": ("reaction_rate:constant:-0.03",),
}
LEAK_SEED = 72_000_000
LATE_ROWS = 150
"""Rows from the end of the training to the finding of a live monitor: 1.5 s of a plant that runs 600 times as fast."""


class Outcome(NamedTuple):
    """Result of a back-test."""

    suspect: tuple[str, float]  # first suspect of the last alarm that names one, with its probability
    verdict: str  # what the baseline was changed for; empty if it was not


def watch_leak(record: Record, *, diagnosed: bool) -> Outcome:
    """Run the monitor over a record, with the diagnosis of its training or without."""
    result = backtest.run(messages_of(record), msgspec.structs.replace(CONFIG, diagnose_training=diagnosed))
    named = [alarm.suspects[0] for alarm, _ in result.raised_alarms if alarm.suspects]
    suspect = (named[-1].cause, named[-1].probability) if named else ("", 0.0)
    return Outcome(suspect, "" if result.baseline is None else result.baseline.why)


def watch_live(record: Record) -> tuple[str, float]:
    """First suspect of a live monitor, which gets the finding `LATE_ROWS` after the training, with its probability."""
    monitor = Monitor(CONFIG, 0, points=False)
    found, suspect = -1, ("", 0.0)
    for message in messages_of(record):
        for item in monitor.on_message(message, 0):
            if isinstance(item.message, Incident) and item.message.suspects:
                suspect = (item.message.suspects[0].cause, item.message.suspects[0].probability)
        if monitor.pipeline.baselines.update.is_pending and found < 0:
            found = monitor.rows + LATE_ROWS
        if monitor.rows == found and (job := monitor.pipeline.baselines.diagnosis_job) is not None:
            monitor.pipeline.baselines.on_finding(find_deviations(job))
    return suspect


def print_training(seeds: int = 2) -> None:
    """Print the first suspects of leaks in plants that were off before."""
    print("before | seed | as given | diagnosed | live | what was found")
    for (name, before), seed in product(BEFORE.items(), range(LEAK_SEED, LEAK_SEED + seeds)):
        config = PlantConfig(seed=seed, faults=(*before, LEAK))
        record = simulate_record(config, int(10 * (LEAK_MIN + LATER_MIN)) + 1)
        given, found = watch_leak(record, diagnosed=False), watch_leak(record, diagnosed=True)
        suspects = given.suspect, found.suspect, watch_live(record)
        texts = [f"{cause or '-'} {probability:.2f}" for cause, probability in suspects]
        print(f"{name} | {seed} | {' | '.join(texts)} | {found.verdict or 'nothing'}", flush=True)


if __name__ == "__main__":
    kind, *numbers = [*sys.argv[1:], *(["bank"] if len(sys.argv) < 2 else [])]
    (print_bank if kind == "bank" else print_training)(*map(int, numbers))
