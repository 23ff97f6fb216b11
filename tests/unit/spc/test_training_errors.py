"""The rate of false alarms of one plant is bounded with the stated confidence, from the errors of its training."""

import numpy as np
import pytest
from scipy import special
from scipy.stats import chi2

from benchmarks.promise.statements import share_worse
from reactorwatch.spc.charts.base import Baseline
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.mewma import Mewma
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.charts.t2 import weighted_chi2_tail
from reactorwatch.spc.false_alarm_budget import TrainingErrors
from reactorwatch.spc.prewhitening import Prewhitening

ARL0, WEIGHT = 20_000.0, 0.1
SETTINGS = {"ewma_weight": WEIGHT, "mewma_weight": 0.02}


def baseline_of(*learned: Prewhitening) -> Baseline:
    e = np.zeros((learned[0].rows, len(learned)))
    return Baseline(learned, e, (1.0,) * len(learned), ARL0, 1.0 / ARL0, SETTINGS)


@pytest.mark.parametrize("coefficient", [0.0, 0.5])
@pytest.mark.parametrize("rows", [100, 1000, 5000])
def test_at_most_a_tenth_of_the_plants_is_worse_than_its_bound(rows: int, coefficient: float) -> None:
    """60 plants, for which three standard errors are 0.12; `make promise` has 1,000."""
    assert share_worse(rows, coefficient, 60) < 0.22


def test_of_an_average_far_more_plants_are_worse() -> None:
    assert share_worse(1000, 0.0, 60, quantile=0.5) > 0.3


@pytest.mark.parametrize("chart", [Shewhart, Ewma])
def test_on_average_over_the_errors_a_chart_has_the_intended_rate(chart: type[Shewhart] | type[Ewma]) -> None:
    learned = Prewhitening(0.1, (0.3,), 1.0, 2000, 0.5 / 2000, 1.0 / 2000)
    rates = chart.relative_rates(baseline_of(learned), TrainingErrors.draw(1))
    assert np.mean(rates) == pytest.approx(1.0, abs=0.1)


def test_the_chart_of_all_outputs_has_the_intended_rate_on_average_too() -> None:
    learned = Prewhitening(0.1, (0.3,), 1.0, 5000, 0.5 / 5000, 1.0 / 5000)
    rates = Mewma.relative_rates(baseline_of(learned, learned), TrainingErrors.draw(2))
    assert np.mean(rates) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("limit", [20.0, 40.0, 80.0])
def test_the_tail_of_a_weighted_sum_is_that_of_the_sum_it_is(limit: float) -> None:
    """Equal weights give chi-square; weights 2, 2, 1, 1 the convolution of two exponentials."""
    equal = weighted_chi2_tail(np.full((1, 6), 2.0), np.zeros((1, 6)), limit)[0]
    assert equal == pytest.approx(chi2.sf(limit / 2.0, 6), rel=0.05)
    mixed = weighted_chi2_tail(np.array([[2.0, 2.0, 1.0, 1.0]]), np.zeros((1, 4)), limit)[0]
    assert mixed == pytest.approx(2.0 * np.exp(-limit / 4.0) - np.exp(-limit / 2.0), rel=0.05)


def test_a_mean_that_is_off_makes_the_tail_that_of_the_noncentral_distribution() -> None:
    tail = weighted_chi2_tail(np.ones((1, 2)), np.array([[4.0, 0.0]]), 30.0)[0]
    assert tail == pytest.approx(float(1.0 - special.chndtr(30.0, 2, 4.0)), rel=0.05)


def test_the_errors_are_the_same_at_each_call() -> None:
    assert all(
        np.array_equal(one, other) for one, other in zip(TrainingErrors.draw(3), TrainingErrors.draw(3), strict=True)
    )
