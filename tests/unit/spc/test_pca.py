"""PCA charts: their limits, and what they blame."""

import msgspec
import numpy as np
import pytest
from scipy import stats

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import JointChart
from reactorwatch.spc.charts.mewma import Mewma
from reactorwatch.spc.charts.pca import PcaModel, PcaSpe, PcaT2
from reactorwatch.spc.charts.t2 import T2
from tests.unit.spc.members import MEMBERS, MODEL, related


def test_the_limit_of_spe_is_that_of_its_distribution() -> None:
    """Equal eigenvalues left out: SPE is their value times chi-square, and the limit near its quantile."""
    model = PcaModel.fit(related(np.random.default_rng(1), 20_000), 2, 0.01)
    left_out = np.array(model.variances[2:])
    exact = left_out.mean() * stats.chi2.isf(0.01, 4)
    assert model.spe_limit == pytest.approx(exact, rel=0.02)


def test_the_limits_of_spe_hold_for_unlike_eigenvalues() -> None:
    """Signals with noise of unlike size: 1 % of fresh samples are out, to 4 standard errors and 0.1 %."""
    rng = np.random.default_rng(2)
    sizes = np.array([0.3, 0.5, 0.7, 0.4, 0.6, 0.8])

    def sample(rows: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        return np.asarray(rng.standard_normal((rows, 1)) + sizes * rng.standard_normal((rows, 6)))

    training, fresh = sample(50_000), sample(20_000)
    chart = PcaSpe(PcaModel.fit(training, 1, 0.01))
    share = np.mean([chart.update(x).out for x in fresh])
    assert abs(share - 0.01) < 4 * np.sqrt(0.01 * 0.99 / 20_000) + 0.001


def test_the_limit_of_t2_allows_for_a_short_training() -> None:
    """Trained on 12 rows only, a fresh sample is out with the probability promised: 4,000 trainings."""
    rng = np.random.default_rng(3)
    mixing = np.array([[1.0, 0.2], [0.2, 1.0], [0.01, 0.01]])
    outs = 0
    for _ in range(4000):
        rows = rng.standard_normal((13, 2)) @ mixing.T + 1e-6 * rng.standard_normal((13, 3))
        outs += PcaT2(PcaModel.fit(rows[:12], 2, 0.05)).update(rows[12]).out
    assert abs(outs / 4000 - 0.05) < 4 * np.sqrt(0.05 * 0.95 / 4000)


@pytest.mark.parametrize("kind", [PcaT2, PcaSpe, T2, Mewma])
def test_contributions_add_up_to_the_statistic(kind: type[JointChart]) -> None:
    chart, samples = MEMBERS[kind].new(), MEMBERS[kind].sample(np.random.default_rng(4), 20)
    for x in samples:
        statistic = chart.update(x).statistic
        assert chart.contributions(x).sum() == pytest.approx(statistic, rel=1e-9)


def test_a_sensor_that_leaves_the_others_is_blamed() -> None:
    """One signal 3 standard deviations off what the others say: SPE is out and that signal has most of it."""
    for sensor in range(6):
        x = np.zeros(6)
        x[sensor] = 3.0
        assert PcaSpe(MODEL).update(x).out
        assert np.argmax(PcaSpe(MODEL).contributions(x)) == sensor


def test_a_large_common_move_is_for_t2_alone() -> None:
    x = np.array([4.0, 4.0, 4.0, 0.0, 0.0, 0.0])
    assert PcaT2(MODEL).update(x).out
    assert not PcaSpe(MODEL).update(x).out


def test_a_covariance_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="covariance must be positive definite"):
        T2([0.0, 0.0], [[1.0, 2.0], [2.0, 1.0]], 10.0)
    with pytest.raises(InputError, match="covariance must be symmetric"):
        T2([0.0, 0.0], [[1.0, 0.1], [0.2, 1.0]], 10.0)
    with pytest.raises(InputError, match=r"covariance must have shape \(2, 2\)"):
        T2([0.0, 0.0], [[1.0]], 10.0)


@pytest.mark.parametrize(
    ("training", "components", "message"),
    [
        (np.ones((10, 3)), 1, "training must vary in every signal, number 0 does not"),
        (np.eye(3), 1, "training must have more rows than its 3 signals, got 3"),
        (np.random.default_rng(1).standard_normal((9, 3)), 3, r"components must be in \[1, 2\] for 3 signals, got 3"),
        (np.full((9, 3), np.nan), 1, "training must be a matrix of finite numbers"),
        (
            np.outer(np.arange(9.0), np.ones(3)),
            1,
            "components must leave some variance over, 1 of 3 signals leave none",
        ),
    ],
)
def test_a_training_that_makes_no_model_is_refused(training: Array, components: int, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PcaModel.fit(training, components)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"variances": np.ones(2)}, "must hold loadings, scales and variances of its 6 signals"),
        ({"scale": np.zeros(6)}, "scales must be positive"),
    ],
)
def test_a_memory_whose_parts_do_not_fit_together_is_refused(change: dict[str, Array], message: str) -> None:
    model = PcaModel.fit(related(np.random.default_rng(1), 100), 2, 0.01)
    with pytest.raises(ValueError, match=message):
        PcaT2(msgspec.structs.replace(model, **change))
