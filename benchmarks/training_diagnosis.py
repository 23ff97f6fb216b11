"""Plants that were a little off the equations from the start: alarms and suspects with the diagnosis and without.

Each record is watched twice, as `backtest` does: judged by the equations as given (`diagnose_training = false`), and by
what the diagnosis of its training found.

    python benchmarks/training_diagnosis.py [sound plants] [seeds a leak]

Leaks: 5 % of the coolant, 60 min after a training of 100 min, new flows in 90 to 111 l/min each minute; the suspect is
the first one 30 min after the onset. Goal: `coolant_flow` with at least 0.8 in each plant.
Sound plants: 750 min, 100 of them training; five deviations, each under three inputs. Goal: alarms within what is
expected.
"""

import sys
import time
from collections.abc import Iterator
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
ONSET_MIN, AFTER_MIN, SOUND_MIN = 160.0, 30.0, 750.0
LEAK = f"coolant_flow:step:-0.05@{ONSET_MIN:g}min"
BEFORE = {
    "nothing": (),
    "feed 1 K warmer": ("feed_temperature:constant:1",),
    "analyser 2 % high": ("concentration_gain:constant:0.02",),
    "reaction 3 % slower": ("reaction_rate:constant:-0.03",),
}
SOUND = {
    "reaction 3 % slower": ("reaction_rate:constant:-0.03",),
    "valve lag 0.12 min": ("valve_lag:constant:0.12",),
    "feed 1 K warmer": ("feed_temperature:constant:1",),
    "3 % more volume": ("volume:constant:0.03",),
    "heat loss 0.003 1/min": ("heat_loss:constant:0.003",),
}
INPUTS = {
    "90..111 each min": {"low": 90.0, "high": 111.0, "hold_min": 1.0},
    "93..109 each 75 min": {"low": 93.0, "high": 109.0, "hold_min": 75.0},
    "+-1 each 2 min": {"low": 99.0, "high": 101.0, "hold_min": 2.0},
}
SOUND_SEED, LEAK_SEED = 71_000_000, 72_000_000
LATE_ROWS = 150
"""Rows from the end of the training to the finding of a live monitor: 1.5 s of a plant that runs 600 times as fast."""


class Outcome(NamedTuple):
    """Result of a back-test."""

    alarms: int  # number of alarms
    expected: float  # number of false alarms to be expected
    suspect: tuple[
        str, float
    ]  # first suspect of the last alarm that names one, with its probability; empty without one
    verdict: str  # what the baseline was changed for; empty if it was not
    seconds: float  # duration of the back-test


def watch(record: Record, *, diagnosed: bool) -> Outcome:
    """Run the monitor over a record."""
    config = msgspec.structs.replace(CONFIG, diagnose_training=diagnosed)
    messages = messages_of(record)
    began_s = time.perf_counter()
    result = backtest.run(messages, config)
    named = [alarm.suspects[0] for alarm, _ in result.raised_alarms if alarm.suspects]
    suspect = (named[-1].cause, named[-1].probability) if named else ("", 0.0)
    why = "" if result.baseline is None else result.baseline.why
    return Outcome(len(result.raised_alarms), result.expected_false_alarms, suspect, why, time.perf_counter() - began_s)


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


def leaks(seeds: int) -> Iterator[tuple[str, int, Outcome, Outcome, tuple[str, float]]]:
    """Leaks in plants that were off before, watched without the diagnosis, with it, and live."""
    for (name, before), number in product(BEFORE.items(), range(seeds)):
        seed = LEAK_SEED + number
        config = PlantConfig(seed=seed, faults=(*before, LEAK))
        record = simulate_record(config, int(10 * (ONSET_MIN + AFTER_MIN)) + 1)
        yield name, seed, watch(record, diagnosed=False), watch(record, diagnosed=True), watch_live(record)


def sound_plants(count: int) -> Iterator[tuple[str, int, Outcome, Outcome]]:
    """Sound plants that are off the equations, watched without the diagnosis and with it."""
    cases = [(kind, scenario) for scenario, kind in product(INPUTS, SOUND)]
    for number in range(count):
        kind, scenario = cases[number * 4 % len(cases)]  # the first few are of several kinds and inputs
        settings = {"kind": "random-steps", **INPUTS[scenario]}
        config = PlantConfig(seed=SOUND_SEED + number, scenario=settings, faults=SOUND[kind])
        record = simulate_record(config, int(10 * SOUND_MIN))
        yield f"{kind}, {scenario}", config.seed, watch(record, diagnosed=False), watch(record, diagnosed=True)


def main(count: int, seeds: int) -> None:
    """Print both tables."""
    print("leak of 5 %, first suspect 30 min after the onset")
    print("before | seed | as given | diagnosed | live | what was found")
    for name, seed, given, found, live in leaks(seeds):
        texts = [f"{cause or '-'} {probability:.2f}" for cause, probability in (given.suspect, found.suspect, live)]
        print(f"{name} | {seed} | {' | '.join(texts)} | {found.verdict or 'nothing'}", flush=True)
    print("\nsound plants, 750 min\nplant | seed | alarms as given | diagnosed | expected | seconds | what was found")
    totals = [0, 0, 0.0]
    for name, seed, given, found in sound_plants(count):
        totals = [totals[0] + given.alarms, totals[1] + found.alarms, totals[2] + found.expected]
        seconds = f"{given.seconds:.2f} and {found.seconds:.2f}"
        text = f"{given.alarms} | {found.alarms} | {found.expected:.2g} | {seconds} | {found.verdict or 'nothing'}"
        print(f"{name} | {seed} | {text}", flush=True)
    print(f"all | | {totals[0]} | {totals[1]} | {totals[2]:.2g}")


if __name__ == "__main__":
    numbers = [int(item) for item in sys.argv[1:]]
    main(*[*numbers, *(6, 2)[len(numbers) :]])
