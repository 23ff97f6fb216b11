"""The promised rate of false alarms is kept on average over trainings, for white and autocorrelated residuals."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special
from scipy.signal import lfilter
from scipy.stats import chi2

from benchmarks.promise.statements import share_worse
from monitor_node.alarms.alarms import AlarmMemory, ChartAlarm
from reactorwatch.errors import InputError
from reactorwatch.spc import false_alarm_budget as budget
from reactorwatch.spc.charts import cusum, ewma, shewhart
from reactorwatch.spc.charts.base import Baseline, Judgement
from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.ewma import Ewma, ewma_limit
from reactorwatch.spc.charts.mewma import Mewma, mewma_limit
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.charts.t2 import joint_limit, weighted_chi2_tail
from reactorwatch.spc.compiled_chart import CompiledChart
from reactorwatch.spc.false_alarm_budget import TrainingErrors
from reactorwatch.spc.prewhitening import Prewhitening, learn
from tests.unit.spc.members import Plants

KNOWN = Prewhitening(0.0, (), 1.0, 10**12, 1e-13, 0.0)
ARL0, TRAINING, WATCHED, PLANTS = 2000.0, 600, 6000, 300


def residuals(phi: float, seed: int, signals: int = 1) -> np.ndarray:
    """Shape (plants, signals, training and watched rows), of unit variance of what drives them."""
    rows = TRAINING + WATCHED
    noise = np.random.default_rng(seed).normal(size=(PLANTS, signals, rows + 200))
    return np.asarray(lfilter([1.0], [1.0, -phi], noise, axis=-1))[..., 200:]


def prewhitened(z: np.ndarray) -> tuple[Prewhitening, np.ndarray]:
    """The training of one residual, and the rows after it in standard deviations."""
    learned = learn(z[:TRAINING], 1e-9)
    order = len(learned.coefficients)
    e = z[TRAINING:] - learned.constant
    for lag, a in enumerate(learned.coefficients, start=1):
        e -= a * z[TRAINING - lag : z.size - lag]
    assert order >= 1
    return learned, e / learned.sd


@cache
def trainings(phi: float) -> list[tuple[Prewhitening, np.ndarray]]:
    """Trainings of 300 plants with one residual each, and the rows after them."""
    return [prewhitened(z[0]) for z in residuals(phi, seed=1)]


def rate_of_one(charts: list[CompiledChart], e: np.ndarray) -> float:
    """Alarms a row, over charts of many plants; each begins anew after its alarm."""
    plants, alarms = Plants(charts), 0
    for values in e.T:
        out = plants.update(values)
        if out.any():
            alarms += int(np.count_nonzero(out))
            plants.restart(out)
    return alarms / e.size


@pytest.mark.parametrize("phi", [0.0, 0.5])
@pytest.mark.parametrize("chart", ["ewma", "cusum", "shewhart"])
def test_each_chart_alarms_as_often_as_its_share_allows(chart: str, phi: float) -> None:
    """300 trainings of 600 rows; 900 alarms are expected, clustered by training, so to a tenth or so."""
    pairs = trainings(phi)
    charts: list[CompiledChart] = []
    for learned, _ in pairs:
        if chart == "ewma":
            charts.append(Ewma(0.0, 1.0, 0.1, ewma.designed_limit(ARL0, 0.1, learned)))
        elif chart == "cusum":
            charts.append(Cusum(0.0, 1.0, 0.5, cusum.designed_limit(ARL0, 0.5, learned)))
        else:
            charts.append(Shewhart(0.0, 1.0, shewhart.designed_width(1 / ARL0, learned)))
    rate = rate_of_one(charts, np.array([e for _, e in pairs]))
    assert 1 / 1.3 < rate * ARL0 < 1.3


def test_without_the_correction_for_the_training_it_alarms_too_often() -> None:
    """What the limits of known parameters do: the reason for the correction."""
    pairs = trainings(0.5)
    plain = ewma_limit(ARL0, 0.03)
    e = np.array([e for _, e in pairs])
    assert rate_of_one([Ewma(0.0, 1.0, 0.03, plain) for _ in pairs], e) * ARL0 > 1.5
    corrected: list[CompiledChart] = [Ewma(0.0, 1.0, 0.03, ewma.designed_limit(ARL0, 0.03, item)) for item, _ in pairs]
    assert 1 / 1.4 < rate_of_one(corrected, e) * ARL0 < 1.4


def test_the_chart_of_all_outputs_alarms_as_often_as_its_share_allows() -> None:
    """Fewer plants, for it is slower: 150 alarms are expected."""
    alarms = rows = 0
    for z in residuals(0.3, seed=2, signals=2)[:50]:
        pairs = [prewhitened(column) for column in z]
        chart = Mewma(
            [0.0, 0.0],
            np.eye(2),
            0.05,
            joint_limit(mewma_limit(ARL0, 2, 0.05), 0.05, [item for item, _ in pairs], TRAINING),
        )
        for values in np.column_stack([e for _, e in pairs]).tolist():
            rows += 1
            if chart.update(values).out:
                alarms += 1
                chart.restart()
    assert 1 / 1.5 < alarms / rows * ARL0 < 1.5


@pytest.mark.parametrize("weight", [0.02, 1.0])
@pytest.mark.parametrize(("outputs", "training", "plants"), [(2, 60, 60), (6, 80, 30), (14, 100, 12), (52, 110, 5)])
def test_a_chart_of_any_number_of_outputs_keeps_its_share(
    outputs: int, training: int, plants: int, weight: float
) -> None:
    """Also where an output's scale has fewer degrees of freedom than there are outputs.

    Alarms come in clusters, by training; 50 and more are expected.
    """
    arl0, rows, alarms = 200.0, 2000, 0
    least_freedom, generator = np.inf, np.random.default_rng(outputs)
    mixed = np.linalg.cholesky(0.5 * np.eye(outputs) + 0.5)
    for _ in range(plants):
        noise = generator.normal(size=(outputs, 50 + training + rows))
        z = mixed @ lfilter([1.0], [1.0, -0.3], noise, axis=-1)[:, 50:]
        learned = [learn(column[:training], 1e-9) for column in z]
        e = np.empty(z.shape)
        for row, (item, column) in enumerate(zip(learned, z, strict=True)):
            e[row] = (lfilter([1.0, *(-a for a in item.coefficients)], [1.0], column) - item.constant) / item.sd
        known = e[:, 6:training]
        white = np.linalg.inv(np.linalg.cholesky(np.corrcoef(known))) @ e[:, training:]
        limit = joint_limit(mewma_limit(arl0, outputs, weight), weight, learned, known.shape[1])
        least_freedom = min(least_freedom, *(0.5 / (item.sd_variance + item.passed_variance) for item in learned))
        first = 0
        while first < rows:
            average = lfilter([weight], [1.0, weight - 1.0], white[:, first:], axis=-1)
            out = np.flatnonzero(np.sum(average**2, axis=0) * (2.0 - weight) / weight > limit)
            first += int(out[0]) + 1 if out.size else rows
            alarms += out.size > 0
    assert outputs < 14 or least_freedom < outputs
    assert 0.1 < alarms / (plants * rows) * arl0 < 1.5


def test_when_all_is_known_limits_are_those_of_the_run_lengths() -> None:
    assert ewma.designed_limit(5000.0, 0.1, KNOWN) == pytest.approx(ewma_limit(5000.0, 0.1), rel=1e-6)
    assert joint_limit(mewma_limit(5000.0, 2, 0.1), 0.1, [KNOWN, KNOWN], 1e12) == pytest.approx(
        mewma_limit(5000.0, 2, 0.1), rel=1e-4
    )
    assert shewhart.designed_width(0.0026997960632602, KNOWN) == pytest.approx(3.0, abs=1e-6)


def test_the_width_of_a_rule_of_several_points_gives_its_rate() -> None:
    """Three of five points, on normal values: the rule itself is run."""
    width = shewhart.designed_width(budget.point_probability(3000.0, 3, 5), KNOWN)
    out = np.abs(np.random.default_rng(5).normal(size=1_000_000)) > width
    alarms = 0
    alarm = ChartAlarm("shewhart", "T", "medium", (3, 5, 1), 0.1)
    points = {False: Judgement(0.0, 0.0, -width, width, False), True: Judgement(2 * width, 0.0, -width, width, True)}
    for is_out in out.tolist():
        if alarm.update(points[is_out]) is not None:
            alarms += 1
            alarm.memory = AlarmMemory()
    assert alarms * 3000.0 / out.size == pytest.approx(1.0, abs=4 / np.sqrt(333))


def test_the_budget_is_shared_equally_and_counts_rows() -> None:
    """One alarm in 30 days of rows every 6 s is one in 432,000 rows; of five charts each has one in five times that."""
    assert budget.share_arl0(1.0, 5, 0.1) == pytest.approx(5 * 432_000)
    assert budget.share_arl0(30.0, 5, 0.1) == pytest.approx(72_000)


@pytest.mark.parametrize("per_30_days", [1e-3, 1e6])
def test_a_budget_that_no_chart_can_keep_is_refused_with_the_range_that_it_can(per_30_days: float) -> None:
    with pytest.raises(InputError, match=r"false_alarms_per_30_days must be in \[0.022, 4.3e\+04\] for 5 alarms"):
        budget.promise_per_30_days(per_30_days, 5, 0.1)


@given(st.floats(1e-5, 1e6), st.integers(3, 1000))
def test_where_nothing_is_asked_for_the_nearest_promise_that_can_be_kept_is_made(
    period_min: float, alarms: int
) -> None:
    """From a row every millisecond to one every two years."""
    promised = budget.promise_per_30_days(None, alarms, period_min)
    arl0 = budget.share_arl0(promised, alarms, period_min)
    assert budget.promise_per_30_days(promised, alarms, period_min) == promised
    assert 50.0 <= arl0 <= 1e8
    assert promised == pytest.approx(min(1.0, 5.0 / period_min)) or (promised > 1.0 and arl0 == pytest.approx(1e8))


@given(st.floats(1e-5, 1e6), st.integers(3, 1000), st.sampled_from([1e-30, 1e30]))
def test_the_bounds_in_a_refusal_can_be_asked_for(period_min: float, alarms: int, asked: float) -> None:
    with pytest.raises(InputError) as refused:
        budget.promise_per_30_days(asked, alarms, period_min)
    low, high = str(refused.value).split("[")[1].split("]")[0].split(", ")
    for bound in (low, high):
        assert budget.promise_per_30_days(float(bound), alarms, period_min) == float(bound)


@pytest.mark.parametrize("rows", [50, 100, 200])
def test_a_cusum_after_a_short_training_has_a_limit_and_a_higher_one(rows: int) -> None:
    """Its mean may be off by more than the allowance, and then the limit is what makes up for it."""
    heights = [
        cusum.designed_limit(1e6, 0.25, Prewhitening(0.0, (0.0,), 1.0, count, 0.5 / count, 1.0 / count))
        for count in (rows, 2 * rows)
    ]
    assert heights[0] > heights[1] > 0.0
    assert np.isfinite(heights[0])


# --- the bound of one plant, from the errors of its training -------------------------------------------------------

SETTINGS = {"ewma_weight": 0.1, "mewma_weight": 0.02}


def baseline_of(*learned: Prewhitening) -> Baseline:
    e = np.zeros((learned[0].rows, len(learned)))
    return Baseline(learned, e, (1.0,) * len(learned), 2e4, 1.0 / 2e4, SETTINGS)


@pytest.mark.parametrize("coefficient", [0.0, 0.5])
@pytest.mark.parametrize("rows", [100, 1000, 5000])
def test_at_most_a_tenth_of_the_plants_is_worse_than_its_bound(rows: int, coefficient: float) -> None:
    """60 plants, for which three standard errors are 0.12; `make promise` has 1,000."""
    assert share_worse(rows, coefficient, 60) < 0.22


def test_of_an_average_far_more_plants_are_worse() -> None:
    assert share_worse(1000, 0.0, 60, quantile=0.5) > 0.3


@pytest.mark.parametrize(("chart", "signals", "rows"), [(Shewhart, 1, 2000), (Ewma, 1, 2000), (Mewma, 2, 5000)])
def test_on_average_over_the_errors_a_chart_has_the_intended_rate(
    chart: type[Shewhart] | type[Ewma] | type[Mewma], signals: int, rows: int
) -> None:
    learned = Prewhitening(0.1, (0.3,), 1.0, rows, 0.5 / rows, 1.0 / rows)
    rates = chart.relative_rates(baseline_of(*[learned] * signals), TrainingErrors.draw(signals))
    assert np.mean(rates) == pytest.approx(1.0, abs=0.15 if signals > 1 else 0.1)


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
