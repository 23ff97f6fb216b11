"""Statements of the monitor held to simulation: its bound on false alarms, and the deviations that it would see."""

from collections import Counter
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy import special
from scipy.signal import lfilter

from benchmarks.harness.plants import messages_of
from benchmarks.harness.study import Pool, head, line, percent, share_interval
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import Encoded
from reactorwatch.spc.charts.base import Baseline
from reactorwatch.spc.charts.ewma import Ewma, designed_limit, ewma_run_length
from reactorwatch.spc.charts.shewhart import Shewhart, designed_width
from reactorwatch.spc.false_alarm_budget import QUANTILE, TrainingErrors
from reactorwatch.spc.prewhitening import Prewhitening, learn

PLANTS, TRAININGS, COEFFICIENTS = 1000, (100, 1000, 5000), (0.0, 0.5)
ARL0, WEIGHT = 20_000.0, 0.1
CAUSES = ("coolant_flow", "feed_temperature", "reaction_rate", "temperature_bias", "concentration_bias")
RUNS, FACTOR, ONSET_MIN, HORIZON_MIN = 40, 1.3, 20.0, 60.0
CONFIG = MonitorConfig(diagnose_training=False, isolation=False)
"""Settings of the runs: the search for causes changes no alarm."""


class Group(NamedTuple):
    """Simulated plants with trainings of one kind."""

    rows: int
    coefficient: float
    plants: int


class Step(NamedTuple):
    """An injected step."""

    cause: str  # cause of the catalogue
    size: float  # size in the unit of the cause
    factor: float  # size relative to the stated one
    seed: int  # seed of the record


def print_tables(pool: Pool, plants: int = PLANTS, runs: int = RUNS) -> None:
    """Print both tables, from simulated plants for each length of the training and faults injected for each size."""
    print(head("rows of the training", "noise of the residual", "plants worse than their bound at 90 % (95 %)"))
    groups = [Group(rows, coefficient, plants) for rows in TRAININGS for coefficient in COEFFICIENTS]
    for group, share in zip(groups, pool.run("trainings", share_of, groups), strict=True):
        low, high = share_interval(round(share * plants), plants)
        worse = f"{100 * share:.1f} % ({100 * low:.1f} to {100 * high:.1f})"
        print(line(f"{group.rows:,}", f"AR {group.coefficient:g}", worse))
    seen_within = f"step, seen within {HORIZON_MIN:g} min (95 %)"
    print(f"\n{head(seen_within, 'size', f'at / {FACTOR:g}', 'at 1', f'at x {FACTOR:g}')}")
    stated, factors = stated_sizes(), (1.0 / FACTOR, 1.0, FACTOR)
    steps = [
        Step(cause, factor * stated[cause] * (1.0 if number % 2 else -1.0), factor, 1000 + number)
        for cause in CAUSES
        for factor in factors
        for number in range(runs)
    ]
    seen = Counter[tuple[str, float]]()
    for step, is_seen in zip(steps, pool.run("steps", sees, steps), strict=True):
        seen[step.cause, step.factor] += is_seen
    for cause in CAUSES:
        shares = [percent(seen[cause, factor], runs) for factor in factors]
        print(line(cause, f"{stated[cause]:.3g}", *shares), flush=True)


def share_of(group: Group) -> float:
    """Share of a group of plants whose true rate of false alarms is above the stated bound."""
    return share_worse(group.rows, group.coefficient, group.plants)


def share_worse(rows: int, coefficient: float, plants: int, quantile: float = QUANTILE) -> float:
    """Share of simulated plants whose true rate of false alarms is above the stated bound.

    Each has one residual, an autoregression, and a Shewhart and an EWMA chart.
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
    return point * ARL0, ARL0 / ewma_run_length(abs(mean) / spread, WEIGHT, limit)


def stated_sizes() -> dict[str, float]:
    """Size of a step of each cause that is seen within an hour, as a monitor states it after a training."""
    config = MonitorConfig(diagnose_training=False)
    first = backtest.run(_messages(30, 2), config, trained=backtest.train(_messages(1000, 1), config))
    return {item.deviation: item.within_1_h or 0.0 for item in first.power if not item.profile}


def sees(step: Step) -> bool:
    """True if an injected step raises an alarm in time."""
    rows = round(10 * (ONSET_MIN + HORIZON_MIN))
    messages = _messages(rows, step.seed, f"{step.cause}:step:{step.size!r}@{ONSET_MIN}min")
    result = backtest.run(messages, CONFIG, trained=_training())
    return any(alarm.raised_ns / 60e9 >= ONSET_MIN for alarm, _ in result.raised_alarms)


@cache
def _training() -> Any:
    return backtest.train(_messages(1000, 1), CONFIG)


def _messages(rows: int, seed: int, *faults: str) -> list[Encoded]:
    return messages_of(simulate_record(PlantConfig(seed=seed, faults=faults), rows))
