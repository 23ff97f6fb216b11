"""The chart on parameters is designed from a training and keeps its false-alarm rate."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy import signal

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.identification.rls import RecursiveLeastSquares
from reactorwatch.spc.charts.parameters import ParameterT2, learn

NAMES = ["a1", "b1", "c"]
FORGETTING, TRAINING = 0.98, 500


class Run(NamedTuple):
    """Of y[k] = 0.8 y[k-1] + 0.5 u[k-1] + v[k]: the rows of its regression, shape (rows, 3) and (rows,)."""

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


def alarms(statistic: Array, limit: float) -> float:
    """How many: a further one only after the statistic has been back where it is half of the time."""
    usual = min(float(np.median(statistic)), limit)
    events = np.where(statistic > limit, 1, np.where(statistic <= usual, -1, 0))
    return float(np.sum(np.diff(events[events != 0], prepend=-1) == 2))


def false_alarms(correlation: float, *, sandwich: bool) -> tuple[float, float]:
    """Of 150 plants over 4,000 rows each: their number over the one promised, 1 in 1,000, and its standard error."""
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
        counts.append(alarms(statistic, chart.limit))
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
