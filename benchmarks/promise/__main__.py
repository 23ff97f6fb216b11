"""`make promise`: false alarms on sound plants that are not quite the model, and faults seen on such plants."""

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

import reactorwatch as rw
from benchmarks.promise.plants import INPUTS, KINDS, Kind, simulate

SEED = 100
ONSET_MIN, WITHIN_MIN = 400.0, 10.0
NOT_WATCHED = ("C every tenth row", "2 % of the rows lost")
"""Kinds without a fault: 27 of the 33 are of the others."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", type=int, default=len(KINDS), help="number of kinds of plants")
    parser.add_argument("--rate", type=float, help="false alarms promised in 30 days [default of the monitor]")
    options = parser.parse_args(arguments)
    kinds = KINDS[: options.kinds]
    settings: dict[str, Any] = {} if options.rate is None else {"false_alarms_per_30_days": options.rate}
    print("| sound plant | false alarms, by input | promised |\n|---|---|---|")
    raised = promised = 0.0
    for number, kind in enumerate(kinds):
        counts, expected = _count_alarms(kind, SEED + 10 * number, settings)
        print(f"| {kind.name} | {' + '.join(map(str, counts))} | {expected:.2g} |", flush=True)
        raised, promised = raised + sum(counts), promised + expected
    low, high = poisson_interval(int(raised))
    print(f"| all | {raised:.0f} (95 %: {low:.1f} to {high:.1f}) | {promised:.2g} |\n")
    delays = [
        delay
        for number, kind in enumerate(kinds)
        if kind.name not in NOT_WATCHED
        for delay in _delays(kind, SEED + 10 * number, settings)
    ]
    seen = sum(delay <= WITHIN_MIN for delay in delays)
    print(
        f"Feed 1.5 K warmer from {ONSET_MIN:g} min on: {seen} of {len(delays)} seen within {WITHIN_MIN:g} min, median "
        f"{np.median(delays):.2f} min."
    )
    return 0


def poisson_interval(count: int) -> tuple[float, float]:
    """Exact 95 % interval of the mean of a Poisson number."""
    low = float(chi2.ppf(0.025, 2 * count)) / 2.0 if count else 0.0
    return low, float(chi2.ppf(0.975, 2 * count + 2)) / 2.0


def _count_alarms(kind: Kind, seed: int, settings: dict[str, Any]) -> tuple[list[int], float]:
    results = [rw.backtest(simulate(kind, flow, seed + j), **settings) for j, flow in enumerate(INPUTS.values())]
    return [len(item.alarms) for item in results], sum(item.expected_false_alarms for item in results)


def _delays(kind: Kind, seed: int, settings: dict[str, Any]) -> list[float]:
    """Minutes from the fault to the first alarm after it, for each input."""
    delays = []
    for j, flow in enumerate(INPUTS.values()):
        found = rw.backtest(simulate(kind, flow, seed + j, warmer_from_min=ONSET_MIN), **settings)
        times = [item.raised_min - ONSET_MIN for item in found.alarms if item.raised_min >= ONSET_MIN]
        delays.append(min(times, default=np.inf))
    return delays


if __name__ == "__main__":
    raise SystemExit(main())
