"""The chart of levels: its run length, its limit after a short training, and that its alarm stands."""

import numpy as np
import pytest
from scipy import signal, special

from reactorwatch.spc.charts.level import Level, independent_values, level_limit, level_run_length
from reactorwatch.spc.charts.value_chart import ValueBaseline
from reactorwatch.stored_state import copy_of

from .members import Array

ARL0, ROWS = 20_000.0, 20_000


def wandering(rng: np.random.Generator, rows: int, signals: int, phi: float = 0.985) -> Array:
    """Autoregressive signals of standard deviation 1, shape (rows, signals)."""
    steps = rng.standard_normal((rows + 1000, signals)) * np.sqrt(1.0 - phi**2)
    return np.asarray(signal.lfilter([1.0], [1.0, -phi], steps, axis=0)[1000:])


def designed(values: Array) -> Level:
    names = tuple(f"s{i}" for i in range(values.shape[1]))
    return Level.design(ValueBaseline(names, values, ARL0 * len(names), {"level_weight": 0.1}))


def test_run_length_is_that_of_independent_values_and_of_the_formula_of_rice() -> None:
    beyond = 2.0 * special.ndtr(-3.5)
    assert level_run_length(3.5, 2.0) == pytest.approx(1.0 / (beyond * (1.0 - 0.5 * beyond)), rel=1e-9)
    step = 1e-4
    rice = np.pi / np.sqrt(step) * np.exp(0.5 * 3.5**2)  # 2 crossings outwards in each period, of two limits
    assert level_run_length(3.5, step) == pytest.approx(rice, rel=1e-3)
    assert level_run_length(level_limit(1e5, 0.03), 0.03) == pytest.approx(1e5, rel=1e-3)


@pytest.mark.parametrize(("signals", "rows"), [(1, 1000), (1, 3400), (9, 1000)])
def test_false_alarms_after_a_training_are_those_promised(signals: int, rows: int) -> None:
    """Simulated, on average over trainings; one excursion is one alarm."""
    rng, found, plants = np.random.default_rng(7), 0.0, 200
    for _ in range(plants):
        values = wandering(rng, rows + ROWS, signals)
        memory = designed(values[:rows]).memory
        averages = signal.lfilter([0.1], [1.0, -0.9], values[rows:] - memory.centres, axis=0)
        out = np.flatnonzero(np.max(np.abs(averages) / memory.scales, axis=1) > memory.limit)
        found += float(1 + np.count_nonzero(np.diff(out) > 20)) if out.size else 0.0
    promised = plants * ROWS / ARL0
    assert 0.4 * promised < found < 1.7 * promised


def test_independent_values_are_those_of_an_autoregression() -> None:
    counts = np.median([independent_values(item) for item in wandering(np.random.default_rng(3), 20_000, 20).T], axis=0)
    exact = 20_000 * np.array([0.015 / 1.985, (1.0 - 0.985**2) / (1.0 + 0.985**2)])
    assert counts == pytest.approx(exact, rel=0.2)


def test_a_fall_is_out_until_the_signal_is_back_and_values_may_be_missing() -> None:
    rng = np.random.default_rng(4)
    values = wandering(rng, 3400, 2)
    chart, falls = designed(values), np.interp(np.arange(1500), [100, 400, 1000, 1100], [0.0, 12.0, 12.0, 0.0])
    rows = wandering(rng, 1500, 2)
    rows[:, 1] -= falls
    rows[300:900:7, 0] = np.nan
    out = np.array([chart.update(row).out for row in rows])
    assert not out[:150].any()
    assert out[300:1000].all()
    assert not out[1200:].any()


def test_a_chart_goes_on_from_its_memory_bit_for_bit() -> None:
    rows = wandering(np.random.default_rng(5), 1200, 3)
    chart = designed(rows[:1000])
    for row in rows[1000:1100]:
        chart.update(row)
    again = Level.resume(copy_of(chart.memory))
    assert [again.update(row) for row in rows[1100:]] == [chart.update(row) for row in rows[1100:]]
