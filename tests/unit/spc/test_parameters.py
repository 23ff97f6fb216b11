"""The chart on parameters: its statistic, its memory of the excitation, and its limit."""

import numpy as np
import pytest
from scipy import signal, stats

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.mewma import mewma_limit
from reactorwatch.spc.charts.parameters import ParameterT2, parameter_limit, prepare_limit
from reactorwatch.stored_state import copy_of
from tests.unit.spc.members import COVARIANCE, ROOT, difference

NAMES = ["a1", "b1", "c"]


def chart() -> ParameterT2:
    """Charts three parameters; the second and third regressor are an input and the offset's 1."""
    return ParameterT2(NAMES, np.linalg.inv(ROOT), 16.0, np.eye(3)[1:], forgetting=0.99)


def rows(seed: int, count: int) -> Array:
    return np.random.default_rng(seed).standard_normal((count, 3))


def test_the_statistic_is_the_distance_measured_by_the_covariance() -> None:
    for d in difference(np.random.default_rng(1), 20):
        assert chart().update(d).statistic == pytest.approx(d @ np.linalg.solve(COVARIANCE, d), rel=1e-12)


def test_excitation_that_is_gone_fades_as_the_rows_are_forgotten() -> None:
    """An input at rest k rows: mean squares f^k and 1, harmonic mean 2 / (f^-k + 1); the statistic by its square."""
    watched, d = chart(), difference(np.random.default_rng(2), 1)[0]
    before = watched.update(d).statistic
    for k in range(1, 500):
        share = 2.0 / (0.99**-k + 1.0)
        assert watched.update(d, [1.0, 0.0, 1.0]).statistic == pytest.approx(share**2 * before, rel=1e-9)
        assert watched.excitation == pytest.approx(share, rel=1e-9)


def test_an_input_at_rest_for_years_leaves_nothing_to_judge() -> None:
    watched = chart()
    for _ in range(20_000):
        said = watched.update([1.0, 1.0, 1.0], [1.0, 0.0, 1.0])
    assert said.statistic == 0.0
    assert not said.out


def test_more_excitation_than_in_the_training_counts_as_the_training_s() -> None:
    watched, d = chart(), difference(np.random.default_rng(3), 1)[0]
    before = watched.update(d)
    for row in rows(4, 300):
        said = watched.update(d, [row[0], 10.0 * row[1], 10.0 * row[2]])
    assert said == before


def test_past_outputs_do_not_count_as_excitation() -> None:
    quiet, loud = chart(), chart()
    for row in rows(5, 100):
        said = quiet.update([0.1, 0.0, 0.0], [0.0, row[1], row[2]])
        assert said == loud.update([0.1, 0.0, 0.0], [1e6, row[1], row[2]])


def test_contributions_add_up_to_the_statistic() -> None:
    watched = chart()
    for row, d in zip(rows(6, 50), difference(np.random.default_rng(6), 50), strict=True):
        said = watched.update(d, row)
        assert watched.contributions(d).sum() == pytest.approx(said.statistic, rel=1e-12)


def test_a_parameter_that_alone_moves_has_all_of_the_statistic() -> None:
    watched = chart()
    said = watched.update([0.0, 0.02, 0.0])
    assert watched.contributions([0.0, 0.02, 0.0]).tolist() == pytest.approx([0.0, said.statistic, 0.0])


def test_a_chart_stopped_and_resumed_with_its_excitation_equals_one_never_stopped() -> None:
    steady, stopped = chart(), chart()
    for row, d in zip(0.5 * rows(7, 40), difference(np.random.default_rng(7), 40), strict=True):
        stopped = ParameterT2.resume(copy_of(stopped.memory))
        assert stopped.update(d, row) == steady.update(d, row)
    stopped.restart()
    assert stopped.memory.to_bytes() == chart().memory.to_bytes() != steady.memory.to_bytes()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_a_regressor_that_is_no_number_is_refused_and_leaves_no_trace(bad: float) -> None:
    watched = chart()
    with pytest.raises(ValueError, match="a chart takes finite values"):
        watched.update([0.1, 0.1, 0.1], [1.0, bad, 1.0])
    assert watched.memory.to_bytes() == chart().memory.to_bytes()


def test_a_wrong_number_of_parameters_is_refused() -> None:
    with pytest.raises(ValueError, match=r"a sample must have shape \(3,\), got \(2,\)"):
        chart().update([0.1, 0.1])
    with pytest.raises(ValueError, match=r"a sample must have shape \(3,\), got \(4,\)"):
        chart().update([0.1, 0.1, 0.1], [1.0] * 4)


def test_a_damaged_memory_is_refused() -> None:
    memory = chart().memory
    memory.excitation = np.array([[1.0, 0.0]])
    with pytest.raises(ValueError, match="excitation must be 2 rows of finite numbers"):
        ParameterT2.resume(memory)


@pytest.mark.parametrize(("dimension", "weight"), [(1, 0.1), (3, 0.01), (7, 0.001)])
def test_the_limit_with_everything_known_is_that_of_the_mewma(dimension: int, weight: float) -> None:
    limit = parameter_limit(1e4, dimension, weight, 1e7, 0.0)
    assert limit == pytest.approx(mewma_limit(1e4, dimension, weight), rel=1e-4)


@pytest.mark.parametrize(("dimension", "freedom"), [(1, 12.0), (3, 25.0), (7, 28.0)])
def test_the_limit_without_memory_is_hotelling_s(dimension: int, freedom: float) -> None:
    """Weight 1, the mean known: p nu / (nu - p + 1) times the quantile of F(p, nu - p + 1)."""
    left = freedom - dimension + 1.0
    exact = dimension * freedom / left * stats.f.isf(1e-3, dimension, left)
    assert parameter_limit(1e3, dimension, 1.0, freedom, 0.0) == pytest.approx(exact, rel=1e-3)


def alarms(statistic: Array, limit: float, centre: float) -> float:
    """How many: a further one only after the statistic has been back at its centre."""
    events = np.where(statistic > limit, 1, np.where(statistic <= centre, -1, 0))
    events = events[events != 0]
    return float(np.sum(np.diff(events, prepend=-1) == 2))


@pytest.mark.parametrize(("dimension", "freedom"), [(2, 20), (4, 40)])
def test_the_limit_keeps_the_rate_of_false_alarms_over_trainings(dimension: int, freedom: int) -> None:
    """Averages of weight 0.05, each with a covariance and an equally uncertain reference of its own.

    2,500 of them, 1,500 rows each, one false alarm in 2,000 promised: 1,875 expected. Within 25 %; the standard error
    is below 6 %.
    """
    rng, weight, plants, arl0 = np.random.default_rng(8), 0.05, 2500, 2000.0
    limit = parameter_limit(arl0, dimension, weight, freedom, 1.0)
    counts = []
    for _ in range(plants):
        vectors = rng.standard_normal((freedom, dimension))
        noise = rng.standard_normal((1700, dimension))
        u = signal.lfilter([np.sqrt(weight * (2.0 - weight))], [1.0, weight - 1.0], noise, axis=0)[200:]
        reference = rng.standard_normal(dimension)
        v = (u - reference) / np.sqrt(2.0)
        statistic = np.sum(v * np.linalg.solve(vectors.T @ vectors / freedom, v.T).T, axis=1)
        centre = 0.5 * (dimension + float(reference @ reference))
        counts.append(alarms(statistic, limit, min(centre, limit)))
    error = np.std(counts) / np.sqrt(plants) / (1500.0 / arl0)
    assert error < 0.06
    assert np.mean(counts) / (1500.0 / arl0) == pytest.approx(1.0, abs=0.25)


def test_a_run_length_that_no_limit_gives_is_refused() -> None:
    with pytest.raises(InputError, match="arl0 must be lower, or the training longer: it has 7 degrees of freedom"):
        parameter_limit(1e8, 7, 0.001, 7.0, 1.0)
    with pytest.raises(InputError, match=r"arl0 must be in \[20, 1e\+08\], got 10"):
        parameter_limit(10.0, 7, 0.001, 40.0, 3.0)


def test_what_is_prepared_is_not_computed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = parameter_limit(1e5, 3, 0.02, 500.0, 0.1)
    assert len(list(prepare_limit(3, 0.01))) > 10

    def fail(*_: object) -> float:
        raise AssertionError("computed again")

    monkeypatch.setattr("reactorwatch.spc.charts.parameters.mewma_run_length", fail)
    assert parameter_limit(1e5, 3, 0.01, 500.0, 0.1) > 0.0
    assert parameter_limit(1e5, 3, 0.02, 500.0, 0.1) == expected


def test_too_many_parameters_for_a_limit_are_an_error_and_nothing_to_prepare() -> None:
    assert list(prepare_limit(101, 0.01)) == []
    with pytest.raises(InputError, match="dimension"):
        parameter_limit(1e5, 101, 0.01, 500.0, 0.1)
