"""The chart on parameters: its statistic, its memory of the excitation, and its limit."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy import signal, stats

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.identification.rls import RecursiveLeastSquares
from reactorwatch.spc.charts.mewma import mewma_limit
from reactorwatch.spc.charts.parameters import ParameterT2, learn, parameter_limit, prepare_limit
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


def test_a_damaged_memory_is_refused() -> None:
    memory = chart().memory
    memory.excitation = np.array([[1.0, 0.0]])
    with pytest.raises(ValueError, match="excitation must be 2 rows of finite numbers"):
        ParameterT2.resume(memory)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((NAMES, np.eye(2), 16.0), "root must be rows of 3 finite numbers, one a parameter"),
        ((NAMES, np.zeros((0, 3)), 16.0), "root must have a row for each direction that is charted, got none"),
        ((NAMES, np.eye(3), 0.0), "limit must be a positive number, got 0.0"),
        ((NAMES, np.eye(3), 16.0, np.eye(2)), "inputs must be rows of 3 finite numbers"),
        ((NAMES, np.eye(3), 16.0, None, 1.0), r"forgetting must be in \(0, 1\), got 1.0"),
    ],
)
def test_settings_out_of_range_are_named(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ParameterT2(*arguments)  # type: ignore[arg-type]


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


def alarms(statistic: Array, limit: float, usual: float) -> float:
    """Count of alarms; the next one comes only after the statistic has been back at its usual value."""
    events = np.where(statistic > limit, 1, np.where(statistic <= usual, -1, 0))
    return float(np.sum(np.diff(events[events != 0], prepend=-1) == 2))


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


# --- the design from a training -----------------------------------------------------------------------------------

FORGETTING, TRAINING = 0.98, 500


class Run(NamedTuple):
    """Rows of the regression of y[k] = 0.8 y[k-1] + 0.5 u[k-1] + v[k], shape (rows, 3) and (rows,)."""

    regressors: Array
    outputs: Array


def run(rng: np.random.Generator, rows: int, correlation: float, u: Array | None = None, gain: float = 0.5) -> Run:
    """A run whose noise v has the standard deviation 0.1 and resembles the one before by `correlation`."""
    if u is None:
        u = rng.standard_normal(rows + 101)
    white = rng.standard_normal(u.size)
    v = signal.lfilter([0.1 * np.sqrt(1.0 - correlation**2)], [1.0, -correlation], white)
    y = signal.lfilter([1.0], [1.0, -0.8], gain * np.concatenate([[0.0], u[:-1]]) + v)
    past = np.column_stack([y[:-1], u[:-1], np.ones(u.size - 1)])
    return Run(past[100:], y[101:])


def adapt(seen: Run, forgetting: float) -> Array:
    """The parameters after each row by weighted least squares over all rows so far, shape (rows, p)."""
    products = seen.regressors[:, :, None] * seen.regressors[:, None, :]
    forget = ([1.0], [1.0, -forgetting])
    # As if nothing had been known before, but for what makes the first rows solvable.
    information = signal.lfilter(*forget, products, axis=0) + 1e-9 * np.eye(seen.regressors.shape[1])
    right = signal.lfilter(*forget, seen.regressors * seen.outputs[:, None], axis=0)
    return np.asarray(np.linalg.solve(information, right[:, :, None])[:, :, 0], dtype=np.float64)


def learned(seen: Run, reference: Array, arl0: float, rows: int = TRAINING) -> ParameterT2:
    residuals = seen.outputs[:rows] - seen.regressors[:rows] @ reference
    return learn(seen.regressors[:rows], residuals, FORGETTING, rows, arl0, NAMES, past_outputs=1)


def textbook(seen: Run, reference: Array, differences: Array) -> Array:
    """Statistic of the chart that takes residuals for white: s^2 H^-1 instead of the sandwich."""
    regressors = seen.regressors[:TRAINING]
    residuals = seen.outputs[:TRAINING] - regressors @ reference
    weight = 1.0 - FORGETTING
    variance = 2.0 * weight / (2.0 - weight) * residuals.var()
    root = np.linalg.cholesky(regressors.T @ regressors / TRAINING).T / np.sqrt(variance)
    return np.asarray(np.sum((differences @ root.T) ** 2, axis=1))


def false_alarms(correlation: float, *, sandwich: bool) -> tuple[float, float]:
    """Alarms of 150 plants over 4,000 rows each, over the promised 1 in 1,000, and their standard error."""
    rng, plants, rows, arl0 = np.random.default_rng(1), 150, 4000, 1000.0
    counts = []
    for _ in range(plants):
        seen = run(rng, TRAINING + rows, correlation)
        parameters = adapt(seen, FORGETTING)
        reference = parameters[TRAINING - 1]
        chart, differences = learned(seen, reference, arl0), parameters[TRAINING:] - reference
        if sandwich:
            rows_after = zip(differences, seen.regressors[TRAINING:], strict=True)
            statistic = np.array([chart.update(d, row).statistic for d, row in rows_after])
        else:
            statistic = textbook(seen, reference, differences)
        counts.append(alarms(statistic, chart.limit, min(float(np.median(statistic)), chart.limit)))
    return float(np.mean(counts)) * arl0 / rows, float(np.std(counts) / np.sqrt(plants)) * arl0 / rows


@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_false_alarms_come_as_rarely_as_promised(correlation: float) -> None:
    """Within a factor of 1.5, with a standard error below 0.12, whether the residual is white or AR(1)."""
    ratio, error = false_alarms(correlation, sandwich=True)
    assert error < 0.12
    assert 1 / 1.5 < ratio < 1.5


def test_without_the_sandwich_a_correlated_residual_breaks_the_promise() -> None:
    """AR(1) with 0.5 and the wider limit even of the sandwich: more than 1.5 times, by over 5 standard errors."""
    ratio, error = false_alarms(0.5, sandwich=False)
    assert ratio - 5.0 * error > 1.5


def test_the_covariance_is_that_of_correlated_scores() -> None:
    """Regressor AR(1) with r, noise AR(1) with q: Omega is H s^2 (1 + r q) / (1 - r q), of an offset (1 + q) / (1 - q).

    To 4 standard errors of a variance from K cosines.
    """
    rng, rows, r, q = np.random.default_rng(2), 20_000, 0.7, 0.6
    x = signal.lfilter([np.sqrt(1.0 - r * r)], [1.0, -r], rng.standard_normal(rows))
    e = 0.1 * signal.lfilter([np.sqrt(1.0 - q * q)], [1.0, -q], rng.standard_normal(rows))
    chart = learn(np.column_stack([x, np.ones(rows)]), e, 0.999, rows, 1e4, ["b1", "c"], past_outputs=0)
    root = chart.memory.root
    covariance = np.linalg.inv(root.T @ root) / (2.0 * 0.001 / 1.999)
    tolerance = 4.0 * np.sqrt(2.0 / (0.4 * rows ** (2 / 3)))
    assert covariance[0, 0] == pytest.approx(0.01 * (1 + r * q) / (1 - r * q), rel=tolerance)
    assert covariance[1, 1] == pytest.approx(0.01 * (1 + q) / (1 - q), rel=tolerance)
    assert abs(covariance[0, 1]) < tolerance * np.sqrt(covariance[0, 0] * covariance[1, 1])


def test_the_difference_has_the_variance_of_two_weighted_means() -> None:
    """Regressors of size 1, white noise: sum f^(2 age) / (sum f^age)^2 over all rows, and over the reference's 60.

    To 4 standard errors of a variance from K cosines.
    """
    rng, rows = np.random.default_rng(3), 20_000
    x, e = rng.choice([-1.0, 1.0], rows), rng.standard_normal(rows)
    chart = learn(x[:, None], e, FORGETTING, 60, 1e4, ["b1"], past_outputs=0)
    weights = FORGETTING ** np.arange(5000)
    exact = sum(np.sum(w**2) / np.sum(w) ** 2 for w in (weights, weights[:60]))
    assert 1.0 / chart.memory.root[0, 0] ** 2 == pytest.approx(exact, rel=4.0 * np.sqrt(2.0 / (0.4 * rows ** (2 / 3))))


def test_a_changed_gain_is_seen_and_blamed_on_the_input() -> None:
    """From 0.5 to 0.6 while the noise has the size 0.1: in each of 10 plants, within 150 rows."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        before, after = run(rng, TRAINING, 0.5), run(rng, 150, 0.5, gain=0.6)
        seen = Run(*(np.concatenate(pair) for pair in zip(before, after, strict=True)))
        parameters = adapt(seen, FORGETTING)
        reference = parameters[TRAINING - 1]
        chart = learned(seen, reference, arl0=1e4)
        assert chart.update(parameters[-1] - reference, seen.regressors[-1]).out
        assert chart.names[int(np.argmax(chart.contributions(parameters[-1] - reference)))] == "b1"


def test_a_plant_that_comes_to_rest_does_not_drift() -> None:
    """Noise on the output, steps of the input in the training, then none: out by far, but for the lost excitation."""
    rng, rest = np.random.default_rng(5), 600
    u = np.concatenate([np.repeat(rng.standard_normal(61), 10)[: TRAINING + 101], np.zeros(rest)])
    clean = signal.lfilter([0.0, 0.5], [1.0, -0.8], u)
    y = clean + 0.1 * rng.standard_normal(u.size)
    seen = Run(np.column_stack([y[:-1], u[:-1], np.ones(u.size - 1)])[100:], y[101:])
    parameters = adapt(seen, FORGETTING)
    reference = parameters[TRAINING - 1]
    unaware, aware = learned(seen, reference, 1e4), learned(seen, reference, 1e4)
    differences = parameters[TRAINING:] - reference
    assert max(unaware.update(d).statistic for d in differences) > 10.0 * unaware.limit
    assert not any(aware.update(d, row).out for d, row in zip(differences, seen.regressors[TRAINING:], strict=True))


def test_an_input_that_never_moved_is_not_charted() -> None:
    """Two directions of three are; the input's parameter counts for nothing, and the others go on to be watched."""
    seen = run(np.random.default_rng(6), TRAINING, 0.0, u=np.zeros(TRAINING + 101))
    chart = learned(seen, adapt(seen, FORGETTING)[-1], arl0=1e4)
    said = chart.update([0.0, 5.0, 0.0], seen.regressors[0])
    assert said.statistic == 0.0
    assert said.centre == 2.0
    assert chart.update([0.9, 0.0, 0.0], seen.regressors[0]).out


def test_lags_of_an_input_at_rest_are_charted_as_the_one_direction_they_are() -> None:
    """Columns b1, b2 and c constant but for a rounding of 1e-6: only their sum tells, and only it is charted."""
    rng = np.random.default_rng(7)
    regressors = np.column_stack([3.0 + 1e-6 * rng.standard_normal((1000, 2)), np.ones(1000)])
    chart = learn(regressors, rng.standard_normal(1000), 0.99, 1000, 1e4, ["b1", "b2", "c"], past_outputs=0)
    assert chart.update([1.0, -1.0, 0.0]).centre == 1.0
    assert chart.update([1.0, -1.0, 0.0]).statistic == pytest.approx(0.0, abs=1e-6)
    assert chart.update([1.0, 0.0, 0.0]).statistic == pytest.approx(chart.update([0.0, 0.0, 3.0]).statistic, rel=1e-3)


def test_a_record_without_noise_makes_no_drift_of_rounding() -> None:
    rng = np.random.default_rng(8)
    rls = RecursiveLeastSquares(3, 0.99)
    regressors = np.column_stack([rng.standard_normal((1500, 2)), np.ones(1500)])
    truth = np.array([0.7, 0.3, 0.1])
    chart = None
    for k, row in enumerate(regressors):
        rls.update(row, float(row @ truth))
        if k == 999:
            reference = rls.parameters
            residuals = regressors[:1000] @ (truth - reference)
            chart = learn(regressors[:1000], residuals, 0.99, 1000, 1e4, NAMES, past_outputs=1)
        if chart is not None:
            assert not chart.update(rls.parameters - reference, row).out


@pytest.mark.parametrize("row", [3, 50, 250, 450, 497])
@pytest.mark.parametrize("lags", [2, 3, 5])
def test_a_training_with_one_step_of_the_input_does_not_determine_how_its_lags_scatter(row: int, lags: int) -> None:
    """The difference of two lags is other than 0 in one row, which the regression explains wholly."""
    rng = np.random.default_rng(row)
    step = (np.arange(-lags, 500) >= row).astype(np.float64)
    regressors = np.column_stack([step[lags - k : 500 + lags - k] for k in range(lags)] + [np.ones(500)])
    with pytest.raises(InputError, match="moves of the inputs in more rows"):
        learn(regressors, rng.standard_normal(500), 0.99, 500, 1e4, [str(k) for k in range(lags + 1)], past_outputs=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": 50}, "training must have at least 58 rows for 3 parameters, got 50"),
        ({"forgetting": 1.0}, r"forgetting must be in \[0.966667, 0.9999\], got 1.0"),
        ({"forgetting": 0.95}, r"forgetting must be in \[0.966667, 0.9999\], got 0.95"),
        ({"arl0": 1.0}, r"arl0 must be in \[10.0004, 1e\+08\], got 1.0"),
        ({"regressors": np.zeros((500, 3))}, "regressors must vary or have an offset, all of them are 0"),
        ({"residuals": np.full(500, np.nan)}, "regressors and residuals must be finite numbers"),
        ({"residuals": np.zeros(499)}, r"as many rows as there are residuals, got \(500, 3\) and \(499,\)"),
        ({"past_outputs": 4}, r"past_outputs must be in \[0, 3\], got 4"),
        ({"reference_rows": 0}, "reference_rows must be in"),
    ],
)
def test_what_cannot_be_learned_is_named(changes: dict[str, object], message: str) -> None:
    rng = np.random.default_rng(9)
    rows = int(str(changes.pop("rows", 500)))
    arguments: dict[str, object] = {
        "regressors": rng.standard_normal((rows, 3)),
        "residuals": rng.standard_normal(rows),
        "forgetting": 0.98,
        "reference_rows": 500,
        "arl0": 1e4,
        "names": NAMES,
        "past_outputs": 1,
    }
    with pytest.raises(InputError, match=message):
        learn(**(arguments | changes))  # type: ignore[arg-type]
