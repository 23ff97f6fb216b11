"""The chart of the residual space: its residuals, its limit by held-out blocks, its promise and what it names."""

import numpy as np
import pytest

from reactorwatch.arrays import BLOCKS
from reactorwatch.spc.averages import independent_rows
from reactorwatch.spc.charts.residual_space import ResidualSpace, held_out_residuals, moderate
from reactorwatch.spc.charts.value_chart import SHRINKAGE, ValueBaseline, adjustment, average_rows

from .members import Array

NAMES = tuple("abcdefgh")
ARL0 = 5000.0


def sound(rng: np.random.Generator, rows: int, load: Array, memory: float = 0.8) -> Array:
    """Signals that are driven by some slow factors, with noise of their own that remembers; shape (rows, signals)."""
    signals, factors = load.shape
    factor, noise = np.zeros(factors), np.zeros(signals)
    out = np.empty((rows + 100, signals))
    for row in range(rows + 100):
        factor = 0.9 * factor + rng.standard_normal(factors)
        noise = memory * noise + rng.standard_normal(signals)
        out[row] = load @ factor + 0.5 * noise
    return out[100:]


def designed(values: Array, arl0: float = ARL0) -> ResidualSpace:
    names = tuple(f"s{i}" for i in range(values.shape[1]))
    return ResidualSpace.design(ValueBaseline(names, values, arl0, {"residual_space_weight": 0.1}))


def test_each_residual_is_that_of_the_regression_of_a_signal_on_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without shrinkage; by least squares, in units of its standard deviation."""
    monkeypatch.setattr("reactorwatch.spc.charts.value_chart.SHRINKAGE", 0.0)
    rng = np.random.default_rng(1)
    rows = sound(rng, 300, rng.standard_normal((5, 2)))
    centre, matrix = adjustment(rows)
    computed = (rows - centre) @ matrix.T
    for i in range(5):
        others = np.column_stack([np.ones(300), np.delete(rows, i, axis=1)])
        residual = rows[:, i] - others @ np.linalg.lstsq(others, rows[:, i], rcond=None)[0]
        assert computed[:, i] == pytest.approx(residual / np.sqrt(np.sum(residual**2) / 299), rel=1e-6, abs=1e-6)


def test_signals_that_follow_from_others_have_residuals_too() -> None:
    rng = np.random.default_rng(2)
    rows = rng.standard_normal((200, 3))
    matrix = adjustment(np.column_stack([rows, rows[:, 0], rows.sum(axis=1)]))[1]
    assert np.isfinite(matrix).all()
    assert np.linalg.cond(matrix) < 100.0 / SHRINKAGE


def test_each_block_is_judged_by_the_others_alone() -> None:
    """A change of a block changes its own residuals only through itself: those of a copy elsewhere are the same."""
    rng = np.random.default_rng(3)
    rows = rng.standard_normal((100, 4))
    edge = 100 // BLOCKS
    centre, matrix = adjustment(rows[edge:])
    assert held_out_residuals(rows)[:edge] == pytest.approx((rows[:edge] - centre) @ matrix.T)


def test_averages_of_white_residuals_have_their_variance_and_the_freedom_of_their_averages() -> None:
    """An average of weight 0.1 has the autocorrelation 0.9^k, so 1 / (1 + 2 sum 0.81^k) = 0.105 of the rows count."""
    averages = average_rows(np.random.default_rng(4).standard_normal((20_000, 10)), 0.1)
    assert np.mean(averages**2, axis=0) * 1.9 / 0.1 == pytest.approx(1.0, abs=0.15)
    assert independent_rows(averages, 100) == pytest.approx(20_000 * 0.19 / 1.81, rel=0.05)


@pytest.mark.parametrize("prior", [6.0, 1e9])
def test_ratios_are_moderated_as_much_as_their_own_spread_is_chance(prior: float) -> None:
    """True ratios drawn from the prior; the estimated degrees of freedom are about its own."""
    rng = np.random.default_rng(5)
    freedom, count = 30.0, 2000
    true = 2.0 * prior / rng.chisquare(prior, count)
    moderated, total = moderate(true * rng.chisquare(freedom, count) / freedom, freedom)
    if prior < 100.0:
        assert total - freedom == pytest.approx(prior, rel=0.15)
        assert np.corrcoef(np.log(true), np.log(moderated))[0, 1] > 0.8
    else:
        assert 10.0 * freedom < total <= count * freedom
        assert moderated == pytest.approx(2.0, rel=0.1)


def test_the_promise_is_kept_by_sound_plants_that_remember() -> None:
    """20 plants of 8 signals, 400 rows of training, 1,500 watched: between a fifth and 1.5 of the promised alarms."""
    raised, rows = 0, 1500
    for seed in range(20):
        rng = np.random.default_rng(seed)
        values = sound(rng, 400 + rows, rng.standard_normal((8, 2)), rng.uniform(0.0, 0.9))
        chart, is_active, normal = designed(values[:400]), False, 0
        for row in values[400:]:
            is_out = chart.update(row).out
            normal = 0 if is_out else normal + 1
            if is_out and not is_active:
                is_active, raised = True, raised + 1
            elif is_active and normal == 20:
                is_active = False
                chart.restart()
    promised = 20 * rows * 8 / ARL0
    assert 0.2 * promised < raised < 1.5 * promised


def test_false_alarms_by_the_errors_of_a_training_are_those_promised_on_average_and_more_for_the_unlucky() -> None:
    """Student's limit holds on average over the errors of a variance, so the mean of the rates is one a signal."""
    rng = np.random.default_rng(8)
    baseline = ValueBaseline(NAMES, sound(rng, 400, rng.standard_normal((8, 2))), 200.0, {"residual_space_weight": 0.1})
    rates = ResidualSpace.relative_rates(baseline)
    assert np.mean(rates) == pytest.approx(8.0, rel=0.1)
    assert np.quantile(rates, 0.9) > 1.1 * np.mean(rates)


@pytest.mark.parametrize("faulty", [0, 7, 19])
def test_a_small_shift_of_one_signal_is_seen_and_named_first(faulty: int) -> None:
    """It is hidden in the signal's own variation; the others give it away."""
    rng = np.random.default_rng(6)
    values = sound(rng, 900, rng.standard_normal((20, 3)), 0.0)
    chart = designed(values[:500], 1e6)
    assert not any(chart.update(row).out for row in values[500:700])
    values[700:, faulty] += values[:500, faulty].std()
    assert any(chart.update(row).out for row in values[700:740])
    text, shares = chart.explain()
    assert next(iter(shares)) == f"s{faulty}"
    assert text.startswith(f"the disturbance enters at s{faulty}: on average s{faulty} (+")
    assert sum(shares.values()) == pytest.approx(1.0)


def test_a_missing_signal_is_replaced_by_its_mean_given_the_others() -> None:
    """Its residual is then 0, as by the regression on the others; with most missing the row is skipped."""
    rng = np.random.default_rng(7)
    values = sound(rng, 400, rng.standard_normal((6, 2)))
    chart, row = designed(values), values[17].copy()
    row[[1, 4]] = np.nan
    filled = chart.fill(row)
    assert filled is not None
    p = len(row)
    matrix, centre = chart.memory.numbers[1 + 2 * p :].reshape(p, p), chart.memory.numbers[1 : 1 + p]
    assert (matrix @ (filled - centre))[[1, 4]] == pytest.approx(0.0, abs=1e-9)
    assert np.delete(filled, [1, 4]) == pytest.approx(np.delete(values[17], [1, 4]))
    row[[0, 2]] = np.nan
    assert chart.fill(row) is None
