"""Statements of the monitor held to simulation: its bound on false alarms, and the deviations that it would see.

python -m benchmarks.promise.statements
"""

import argparse
from collections.abc import Sequence

import numpy as np
from scipy import special
from scipy.signal import lfilter

from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import Encoded, encode
from reactorwatch.spc.baseline import Baseline
from reactorwatch.spc.charts.ewma import Ewma, designed_limit
from reactorwatch.spc.charts.shewhart import Shewhart, designed_width
from reactorwatch.spc.prewhitening import Prewhitening, learn
from reactorwatch.spc.run_length.ewma import ewma
from reactorwatch.spc.training_errors import QUANTILE, TrainingErrors
from recorder.tools.player import samples_of

PLANTS, TRAININGS, COEFFICIENTS = 1000, (100, 1000, 5000), (0.0, 0.5)
ARL0, WEIGHT = 20_000.0, 0.1
CAUSES = ("coolant_flow", "feed_temperature", "reaction_rate", "temperature_bias", "concentration_bias")
RUNS, FACTOR, ONSET_MIN, HORIZON_MIN = 40, 1.3, 20.0, 60.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=PLANTS, help="simulated plants for each length of the training")
    parser.add_argument("--runs", type=int, default=RUNS, help="faults injected for each size")
    options = parser.parse_args(arguments)
    print("| rows of the training | noise of the residual | plants worse than their bound at 90 % |\n|---|---|---|")
    for rows in TRAININGS:
        for coefficient in COEFFICIENTS:
            share = share_worse(rows, coefficient, options.plants)
            error = 1.96 * np.sqrt(share * (1.0 - share) / options.plants)
            print(f"| {rows:,} | AR {coefficient:g} | {100 * share:.1f} % (+- {100 * error:.1f}) |", flush=True)
    print(f"\n| step, seen within {HORIZON_MIN:g} min | stated size | seen at / {FACTOR:g} | at 1 | at x {FACTOR:g} |")
    print("|---|---|---|---|---|")
    for cause, size, shares in seen_shares(options.runs):
        print(f"| {cause} | {size:.3g} | {' | '.join(f'{100 * share:.0f} %' for share in shares)} |", flush=True)
    return 0


def share_worse(rows: int, coefficient: float, plants: int, quantile: float = QUANTILE) -> float:
    """Share of simulated plants whose true rate of false alarms is above the stated bound.

    Each has one residual, an autoregression, and a Shewhart and an EWMA chart.

    Args:
        rows: rows of the training.
        coefficient: coefficient of the autoregression.
        plants: number of plants.
        quantile: quantile of the rate that is the bound.
    """
    generator, errors = np.random.default_rng(rows), TrainingErrors.draw(1)
    worse = 0
    for _ in range(plants):
        z = lfilter([1.0], [1.0, -coefficient], generator.normal(size=rows + 100))[100:]
        learned = learn(z, 1e-9)
        settings = {"ewma_weight": WEIGHT}
        baseline = Baseline((learned,), np.zeros((rows, 1)), (1.0,), ARL0, 1.0 / ARL0, settings)
        draws = Shewhart.relative_rates(baseline, errors) + Ewma.relative_rates(baseline, errors)
        worse += sum(_true_rates(learned, coefficient)) > float(np.quantile(draws, quantile))
    return worse / plants


def _true_rates(learned: Prewhitening, coefficient: float) -> tuple[float, float]:
    """Rates of both charts relative to the intended one, from the process itself."""
    impulse = np.eye(1, 400)[0]
    response = lfilter([1.0, *(-a for a in learned.coefficients)], [1.0, -coefficient], impulse) / learned.sd
    mean, sd = -learned.constant / learned.sd, float(np.sqrt(response @ response))
    width = designed_width(1.0 / ARL0, learned)
    point = float(special.ndtr(-(width - mean) / sd) + special.ndtr(-(width + mean) / sd))
    averaged = lfilter([WEIGHT], [1.0, WEIGHT - 1.0], response)
    spread = float(np.sqrt(averaged @ averaged * (2.0 - WEIGHT) / WEIGHT))
    limit = min(designed_limit(ARL0, WEIGHT, learned) / spread, 6.0)  # beyond, the rate is nothing
    return point * ARL0, ARL0 / ewma(abs(mean) / spread, WEIGHT, limit)


def seen_shares(runs: int) -> list[tuple[str, float, list[float]]]:
    """Cause, stated size, and shares of injected steps seen in time: of that size over a factor, itself, times it."""
    config = MonitorConfig(diagnose_training=False)
    trained = backtest.train(_messages(1000, 1), config)
    first = backtest.run(_messages(30, 2), config, trained=trained)
    assert first.promise is not None
    stated = {item.deviation: item.within_1_h for item in first.promise.power if not item.profile}
    found = []
    for cause in CAUSES:
        shares = []
        for factor in (1.0 / FACTOR, 1.0, FACTOR):
            seen = 0
            for number in range(runs):
                size = factor * stated[cause] * (1.0 if number % 2 else -1.0)
                rows = _messages(
                    round(10 * (ONSET_MIN + HORIZON_MIN)), 1000 + number, f"{cause}:step:{size!r}@{ONSET_MIN}min"
                )
                result = backtest.run(rows, config, trained=trained)
                seen += any(alarm.raised_ns / 60e9 >= ONSET_MIN for alarm, _ in result.raised_alarms)
            shares.append(seen / runs)
        found.append((cause, stated[cause], shares))
    return found


def _messages(rows: int, seed: int, *faults: str) -> list[Encoded]:
    record = simulate_record(PlantConfig(seed=seed, faults=faults), rows)
    return [encode(item) for item in samples_of(record, "cstr")]


if __name__ == "__main__":
    raise SystemExit(main())
