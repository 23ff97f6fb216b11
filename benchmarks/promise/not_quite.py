"""False alarms and delays of monitors of plants that are not quite the model."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

import reactorwatch as rw
from benchmarks.harness.plants import INPUTS, KINDS, simulate
from benchmarks.harness.study import Pool, head, line, median_interval, poisson_interval, share_interval

SEED, SEED_STEP = 100, 1000
"""Seed of the first plant of the first set, and the difference to that of the next set."""

HIGH_RATE = 30.0
"""False alarms promised in 30 days in the second table."""

ONSET_MIN, WITHIN_MIN = 400.0, 10.0
NOT_WATCHED = ("C every tenth row", "2 % of the rows lost")
"""Kinds without a fault: 27 of the 33 are of the others."""


class Plant(NamedTuple):
    """A plant and its monitor."""

    kind: int  # index of its kind
    moves: int  # index of its input
    set: int = 0  # index of the set of plants, which differ in their seeds
    rate: float | None = None  # false alarms promised in 30 days; None: the default of the monitor
    is_faulty: bool = False  # true if its feed is 1.5 K warmer from `ONSET_MIN` on


class Outcome(NamedTuple):
    """Result of a back-test."""

    raised_min: list[float]  # times of the alarms
    expected: float  # false alarms promised
    kept: bool  # false if the monitor says that the promise is not kept


def watch(plant: Plant) -> Outcome:
    """Simulate a plant and watch it."""
    seed = SEED + 10 * plant.kind + plant.moves + SEED_STEP * plant.set
    flow = list(INPUTS.values())[plant.moves]
    record = simulate(KINDS[plant.kind], flow, seed, warmer_from_min=ONSET_MIN if plant.is_faulty else None)
    settings: dict[str, Any] = {} if plant.rate is None else {"false_alarms_per_30_days": plant.rate}
    found = rw.backtest(record, **settings)
    kept = found.promise is None or found.promise["kept"]
    return Outcome([item.raised_min for item in found.alarms], found.expected_false_alarms, kept)


def print_plants(pool: Pool, count: int) -> None:
    """Watch sound plants and plants with a fault, and print the tables."""
    kinds, moves = range(count), range(len(INPUTS))
    sound = [Plant(kind, move) for kind in kinds for move in moves]
    often = [Plant(kind, move, number, HIGH_RATE) for number in (0, 1) for kind in kinds for move in moves]
    faulty = [item._replace(is_faulty=True) for item in sound if KINDS[item.kind].name not in NOT_WATCHED]
    outcomes = iter(pool.run("plants", watch, [*sound, *often, *faulty]))
    print_counts("the default promise", sound, outcomes)
    for number in (0, 1):
        own = [item for item in often if item.set == number]
        print_counts(f"{HIGH_RATE:g} false alarms promised in 30 days, set {number + 1}", own, outcomes)
    print_delays(faulty, outcomes)


def print_counts(title: str, plants: Sequence[Plant], outcomes: Iterator[Outcome]) -> None:
    """Print the table of false alarms of sound plants, by kind and input; takes their outcomes."""
    print(head(f"sound plant, {title}", "false alarms, by input", "promised", "not kept"))
    found = [(plant, next(outcomes)) for plant in plants]
    for kind in dict.fromkeys(plant.kind for plant in plants):
        own = [(plant.moves, outcome) for plant, outcome in found if plant.kind == kind]
        counts = [sum(len(item.raised_min) for moves, item in own if moves == index) for index in range(len(INPUTS))]
        promised, broken = sum_up(item for _, item in own)
        print(line(KINDS[kind].name, " + ".join(map(str, counts)), f"{promised:.2g}", broken))
    raised = sum(len(item.raised_min) for _, item in found)
    promised, broken = sum_up(item for _, item in found)
    low, high = poisson_interval(raised)
    counted = f"{raised} (95 %: {low:.1f} to {high:.1f})"
    print(line("all", counted, f"{promised:.2g}", f"{broken} of {len(found)}"), end="\n\n")


def sum_up(outcomes: Iterable[Outcome]) -> tuple[float, int]:
    """False alarms promised, and number of plants whose monitor says that the promise is not kept."""
    both = [(item.expected, not item.kept) for item in outcomes]
    return sum(expected for expected, _ in both), sum(broken for _, broken in both)


def print_delays(plants: Sequence[Plant], outcomes: Iterator[Outcome]) -> None:
    """Print how many faults are seen, and when."""
    found = [(KINDS[plant.kind].name, delay(next(outcomes))) for plant in plants]
    seen = sum(size <= WITHIN_MIN for _, size in found)
    low, high = share_interval(seen, len(found))
    unseen = sorted({name for name, size in found if size > WITHIN_MIN})
    delays = [size for _, size in found]
    least, most = median_interval(delays)
    print(
        f"Feed 1.5 K warmer from {ONSET_MIN:g} min on: {seen} of {len(found)} seen within {WITHIN_MIN:g} min (95 %: "
        f"{100 * low:.0f} to {100 * high:.0f} %), median {np.median(delays):.2f} min ({least:.2f} to {most:.2f})"
        f"{'; unseen: ' + ', '.join(unseen) if unseen else ''}."
    )


def delay(outcome: Outcome) -> float:
    """Minutes from the fault to the first alarm after it."""
    return min((time - ONSET_MIN for time in outcome.raised_min if time >= ONSET_MIN), default=np.inf)
