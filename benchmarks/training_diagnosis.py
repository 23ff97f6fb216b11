"""Suspects of a leak in plants that were a little off the equations from the start, with the diagnosis and without.

    python benchmarks/training_diagnosis.py [seeds]

A leak of 5 % of the coolant, 60 min after a training of 100 min, new flows in 90 to 111 l/min each minute, judged by
the equations as given (`diagnose_training = false`), by what the diagnosis of the training found, and live. The first
suspect 30 minutes after the onset. Goal: `coolant_flow` with at least 0.8 in each plant. `make promise` has the false
alarms of such plants.
"""

import sys
from itertools import product
from typing import NamedTuple

import msgspec

from benchmarks.harness.plants import messages_of
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.diagnosis_worker import find_deviations
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.messages_pb2 import Incident
from reactorwatch.records.record import Record

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
    print_training(*map(int, sys.argv[1:]))
