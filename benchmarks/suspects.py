"""Rank of the true cause among the monitor's suspects, 150 minutes after the onset of a fault.

Two sets: the medium faults of the bank (`benchmarks/harness/bank.py`), and steps of every cause from seeds and onsets
that the bank does not have, of medium and of half of medium size.

    python benchmarks/suspects.py [seeds of the bank] [first seed of the steps] [processes]

Goals: first in 80 % of the bank's medium faults, among the first two in 92 %; first in 14 of 16 steps.
"""

import sys

import numpy as np

from benchmarks.faults.detectors import newest_suspects, watch
from benchmarks.harness.bank import AFTER_MIN, BANK, Case, cases, record_of
from benchmarks.harness.study import Pool, share_interval

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


def main(seeds: int = 1, first_seed: int = FIRST_SEED, jobs: int | None = None) -> None:
    """Print both tables."""
    pool = Pool(jobs)
    medium = [case for case in cases(seeds) if case.grade == "medium"]
    print_ranks(f"medium faults of the bank, {AFTER_MIN:g} min", medium, pool)
    for factor in (1.0, 0.5):
        print_ranks(f"fresh steps, {factor:g} of medium", fresh_steps(factor, first_seed), pool)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
