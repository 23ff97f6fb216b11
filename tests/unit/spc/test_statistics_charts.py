"""Charts of statistics of a model of all signals: their models against independent computations, and their promise."""

from collections.abc import Callable
from itertools import pairwise
from types import MappingProxyType

import numpy as np
import pytest

from reactorwatch.spc.charts.base import Setting
from reactorwatch.spc.charts.catalogue import CHARTS
from reactorwatch.spc.charts.cva_residual import ROWS, CvaResidual, inverse_root
from reactorwatch.spc.charts.multiple_pca import Mixture, MultiplePca, divide, fit_mixture, maximise
from reactorwatch.spc.charts.multiway_pca import STAGES, MultiwayPca, batch_starts
from reactorwatch.spc.charts.pls import Pls, Projection, choose_components
from reactorwatch.spc.charts.value_chart import StatisticsChart, ValueBaseline, average_variance
from reactorwatch.spc.prewhitening import Prewhitening
from tests.unit.spc.members import Array
from tests.unit.spc.test_residual_space import sound

KINDS = [kind for kind in CHARTS if issubclass(kind, StatisticsChart)]
SETTINGS = MappingProxyType(
    {item.key: item.default for kind in KINDS for item in kind.settings if isinstance(item, Setting)}
)
SIGNALS = MappingProxyType({"pls_quality": ("s7",), "multiway_pca_progress": ("s0",)})


def baseline_of(values: Array, arl0: float = 3000.0) -> ValueBaseline:
    return ValueBaseline(tuple(f"s{i}" for i in range(values.shape[1])), values, arl0, SETTINGS, SIGNALS)


def plant(seed: int, rows: int) -> Array:
    """Eight signals with two slow factors and noise that remembers."""
    rng = np.random.default_rng(seed)
    return sound(rng, rows, rng.standard_normal((8, 2)), rng.uniform(0.0, 0.9))


def in_batches(seed: int, rows: int) -> Array:
    """Batches of 24 to 36 rows: the share of the batch, and seven signals with courses, offsets and noise."""
    rng = np.random.default_rng(seed)
    values: list[list[float]] = []
    while len(values) < rows:
        share = np.linspace(0.0, 1.0, int(rng.integers(24, 37)))
        courses = np.array([share**2, np.sin(3.0 * share), np.exp(-share), 2.0 * share, 1 - share, share, share**3])
        common, noise = 0.05 * rng.standard_normal(), np.zeros(7)
        for s, course in zip(share, courses.T, strict=True):
            noise = 0.5 * noise + 0.05 * rng.standard_normal(7)
            values.append([s, *(course + common * np.array([1.0, 1.0, -1.0, 0.5, 1.0, -1.0, 0.0]) + noise)])
    return np.array(values[:rows])


def regimes(seed: int, rows: int) -> Array:
    """Eight signals at one of two loads for 100 rows at a time, between which their relations differ."""
    rng = np.random.default_rng(seed)
    load = np.random.default_rng(1).standard_normal((2, 8, 2))
    is_high = np.arange(rows) // 100 % 2
    factors = rng.standard_normal((rows, 2))
    values = np.einsum("nij,nj->ni", load[is_high], factors) + 0.3 * rng.standard_normal((rows, 8))
    return np.asarray(values + 12.0 * is_high[:, None])


SOUND: dict[type[StatisticsChart], Callable[[int, int], Array]] = {MultiplePca: regimes, MultiwayPca: in_batches}
"""Sound rows by chart; other charts get those of `plant`."""
PROMISED = [pytest.param(kind, marks=[pytest.mark.slow] if kind is MultiplePca else []) for kind in KINDS]
"""Charts whose promise is tested; the mixture of `multiple_pca` is fitted for twenty seconds."""


def count_alarms(chart: StatisticsChart, values: Array) -> int:
    """Alarms over rows; one ends after 20 rows within the limit."""
    raised, normal = 0, 20
    for row in values:
        is_out = chart.update(row).out
        raised += is_out and normal >= 20
        normal = 0 if is_out else normal + 1
        if normal == 20:
            chart.restart()
    return raised


@pytest.mark.parametrize("kind", PROMISED, ids=lambda kind: kind.name)
def test_the_promise_is_kept_by_sound_plants_that_remember(kind: type[StatisticsChart]) -> None:
    """6 plants, 600 rows of training and 1,000 watched: at most 1.5 of the promised alarms."""
    raised = sum(
        count_alarms(kind.design(baseline_of(values[:600], 8000.0)), values[600:])
        for values in (SOUND.get(kind, plant)(seed, 1600) for seed in range(6))
    )
    promised = 6 * 1000 * 8 / 8000.0
    assert raised <= 1.5 * promised


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_parts_of_the_signals_add_up_to_the_statistics(kind: type[StatisticsChart]) -> None:
    values = SOUND.get(kind, plant)(1, 600)
    model = kind.fit(values, baseline_of(values))
    for row in range(20, 40):
        window = values[row - kind.rows_before : row + 1]
        assert kind.parts(model, window).sum(axis=1) == pytest.approx(kind.statistics(model, window), rel=1e-9)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_a_shift_of_a_signal_raises_the_chart_which_names_it_among_three(kind: type[StatisticsChart]) -> None:
    values = SOUND.get(kind, plant)(2, 900)
    chart = kind.design(baseline_of(values[:600], 1e5))
    values[700:, 3] += 3.0 * values[:600, 3].std()
    assert not any(chart.update(row).out for row in values[600:700])
    assert any(chart.update(row).out for row in values[700:])
    text, shares = chart.explain()
    assert "s3" in list(shares)[:3]
    assert "s3 (" in text
    assert sum(shares.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("coefficients", [(), (0.6,), (0.4, -0.3, 0.2)])
def test_the_variance_of_an_average_is_that_of_a_long_simulation(coefficients: tuple[float, ...]) -> None:
    rng, weight = np.random.default_rng(3), 0.1
    z, average, squares = [0.0] * 3, 0.0, []
    for noise in rng.standard_normal(60_000):
        value = noise + sum(a * past for a, past in zip(coefficients, z, strict=False))
        z = [value, *z[:2]]
        average += weight * (value - average)
        squares.append(average**2)
    learned = Prewhitening(0.0, coefficients, 1.0, 100, 0.0, 0.0)
    assert average_variance(learned, weight) == pytest.approx(np.mean(squares), rel=0.06)


def test_one_wild_row_raises_no_alarm_and_the_end_of_a_large_change_clears_it() -> None:
    values = plant(4, 700)
    chart = CvaResidual.design(baseline_of(values[:400], 1e5))
    wild = values[400:500].copy()
    wild[50] += 1e6
    assert not any(chart.update(row).out for row in wild)
    for row in values[500:560]:
        chart.update(row + np.arange(8.0) * 100.0)
    assert chart.update(values[559] + np.arange(8.0) * 100.0).out
    assert sum(chart.update(row).out for row in values[560:700]) < 1.5 / chart.weight


def test_tr2_is_the_length_of_the_past_beside_its_canonical_variates() -> None:
    """The variates by the generalised eigenvalue problem; T2 of the whole past minus that of the state."""
    values = plant(5, 600)
    model = CvaResidual.fit(values, baseline_of(values))
    x = (values - values.mean(axis=0)) / values.std(axis=0, ddof=1)
    rows = len(x) - 2 * ROWS + 1
    past = np.array([x[i : i + ROWS].ravel() for i in range(rows)])
    future = np.array([x[i + ROWS : i + 2 * ROWS].ravel() for i in range(rows)])
    joint = np.cov(past, future, rowvar=False)
    of_past, of_future, cross = joint[:24, :24], joint[24:, 24:], joint[:24, 24:]
    squared, vectors = np.linalg.eig(np.linalg.solve(of_past, cross @ np.linalg.solve(of_future, cross.T)))
    order = np.argsort(-squared.real)[: 24 - len(model["rest"])]
    states = vectors.real[:, order]
    off = x[50 : 50 + ROWS].ravel()
    scores = states.T @ off
    state = scores @ np.linalg.solve(states.T @ of_past @ states, scores)
    expected = (off @ np.linalg.solve(of_past, off) - state) / len(model["rest"])
    assert CvaResidual.statistics(model, values[50 : 50 + ROWS])[0] == pytest.approx(expected, rel=1e-6)


def test_held_out_statistics_are_corrected_to_those_of_new_rows_after_the_whole_training() -> None:
    """Independent rows: 5 blocks of 300 rows, 24 values of the past; new rows have the corrected mean."""
    rng = np.random.default_rng(6)
    values = rng.standard_normal((3300, 8))
    baseline = baseline_of(values[:300])
    roots, model = CvaResidual.held_out_roots(baseline), CvaResidual.fit(values[:300], baseline)
    new = [CvaResidual.statistics(model, values[row - ROWS + 1 : row + 1])[0] for row in range(302, 3300)]
    assert np.nanmean(roots) == pytest.approx(np.mean(np.cbrt(new)), rel=0.02)
    assert np.isnan(roots[:, 0]).sum() == sum(ROWS - 1 for _ in pairwise(CvaResidual.edges(baseline)))


@pytest.mark.parametrize("quality", [1, 2])
def test_projections_are_those_of_scikit_learn(quality: int) -> None:
    pytest.importorskip("sklearn", reason="scikit-learn is not installed")
    from sklearn.cross_decomposition import PLSRegression  # type: ignore[import-untyped]

    rng = np.random.default_rng(7)
    x = rng.standard_normal((60, 5))
    y = x @ rng.standard_normal((5, quality)) + 0.3 * rng.standard_normal((60, quality))
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    theirs = PLSRegression(3, scale=False, tol=1e-14, max_iter=5000).fit(x, y)
    ours = Projection.fit(x, y, 3)
    assert ours.predict(x) == pytest.approx(theirs.predict(x).reshape(y.shape), abs=1e-6)
    assert np.abs(ours.rotations) == pytest.approx(np.abs(theirs.x_rotations_), abs=1e-6)
    assert np.abs(ours.loadings) == pytest.approx(np.abs(theirs.x_loadings_), abs=1e-6)


def test_the_number_of_components_is_that_which_predicts_held_out_rows() -> None:
    """Quality that depends on two of six equally strong directions, with a little noise."""
    rng = np.random.default_rng(8)
    x = rng.standard_normal((400, 6)) * np.array([3.0, 3.0, 1.0, 1.0, 1.0, 1.0])
    y = x[:, :1] - 2.0 * x[:, 2:3] + 0.05 * rng.standard_normal((400, 1))
    count = choose_components(x, y)
    errors = [np.mean((Projection.fit(x[:200], y[:200], a).predict(x[200:]) - y[200:]) ** 2) for a in range(1, 7)]
    assert errors[count - 1] < 1.05 * min(errors)


def test_t2_and_spe_of_pls_are_those_of_its_scores_and_the_alarm_predicts_the_quality() -> None:
    values = plant(9, 600)
    values[:, 7] = values[:, 0] - values[:, 1] + 0.1 * values[:, 7]
    chart = Pls.design(baseline_of(values[:400], 1e5))
    model = chart.model
    z = ((values - values[:400].mean(axis=0)) / values[:400].std(axis=0, ddof=1))[:, :7]
    scores = z @ model["rotations"]
    t2 = np.sum(scores**2 / scores[:400].var(axis=0, ddof=1), axis=1) / scores.shape[1]
    spe = np.sum((z - scores @ model["loadings"].T) ** 2, axis=1)
    expected = np.column_stack([t2, spe / spe[:400].mean()])
    found = np.array([Pls.statistics(model, row[None]) for row in values[400:420]])
    assert found == pytest.approx(expected[400:420], rel=1e-9)
    faulty = values[450] + np.array([0.0, 0, 0, 8.0, 0, 0, 0, 1e3])  # the quality itself is not looked at
    assert any(chart.update(faulty).out for _ in range(60))
    text = chart.explain()[0]
    predicted = float(text.rpartition("predicted quality: s7 ")[2])
    least_squares = np.linalg.lstsq(np.column_stack([np.ones(400), values[:400, :7]]), values[:400, 7], rcond=None)[0]
    assert predicted == pytest.approx(least_squares @ [1.0, *faulty[:7]], abs=values[:400, 7].std())


def test_directions_without_variance_are_left_out() -> None:
    root = inverse_root(np.diag([4.0, 1.0, 0.0]))
    assert np.sort(np.abs(root).ravel()) == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.5, 1.0])


def test_memberships_are_those_of_scikit_learn() -> None:
    """The same mixture by expectation maximisation from the same start."""
    pytest.importorskip("sklearn", reason="scikit-learn is not installed")
    from sklearn.mixture import GaussianMixture  # type: ignore[import-untyped]

    rng = np.random.default_rng(10)
    rows = np.concatenate(
        [rng.standard_normal((200, 2)), [4.0, 1.0] + rng.standard_normal((300, 2)) @ [[1.0, 0.5], [0, 0.3]]]
    )
    start = divide(rows, 2, np.random.default_rng(1))
    ours = maximise(rows, start, 10.0)
    assert ours is not None
    means = start.T @ rows / start.sum(axis=0)[:, None]
    theirs = GaussianMixture(2, means_init=means, tol=1e-8, max_iter=1000).fit(rows)
    assert ours.memberships(rows) == pytest.approx(theirs.predict_proba(rows), abs=0.02)
    assert ours.log_likelihood(rows) / len(rows) == pytest.approx(theirs.score(rows), abs=1e-3)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_there_are_as_many_regimes_as_the_rows_have(count: int) -> None:
    rng = np.random.default_rng(11)
    rows = np.concatenate([rng.standard_normal((200, 2)) + 8.0 * np.array([g, g % 2]) for g in range(count)])
    assert fit_mixture(rows, 4, 30.0).shares == pytest.approx(np.full(count, 1.0 / count), abs=0.02)


def test_t2_and_spe_of_a_regime_are_those_of_pca_of_its_rows() -> None:
    """The regimes are far apart, so each row belongs to one: scikit-learn on the rows of one regime gives the same."""
    pytest.importorskip("sklearn", reason="scikit-learn is not installed")
    from sklearn.decomposition import PCA  # type: ignore[import-untyped]

    values = regimes(12, 800)
    model = MultiplePca.fit(values, baseline_of(values))
    assert model["shares"] == pytest.approx([0.5, 0.5], abs=1e-6)
    z = (values - values.mean(axis=0)) / values.std(axis=0, ddof=1)
    own = z[np.arange(800) // 100 % 2 == 0]
    count = int(np.count_nonzero(model["variances"][np.argmin(model["centres"][:, 0])]))
    theirs = PCA(count).fit(own)
    scores = theirs.transform(own)
    t2 = np.mean(scores**2 / scores.var(axis=0), axis=1)
    spe = np.sum((own - theirs.inverse_transform(scores)) ** 2, axis=1)
    found = np.array([MultiplePca.statistics(model, row[None]) for row in values[:50]])
    assert found == pytest.approx(np.column_stack([t2, spe / spe.mean()])[:50], rel=1e-4)


def test_a_row_between_regimes_is_judged_by_both() -> None:
    values = regimes(13, 800)
    model = MultiplePca.fit(values, baseline_of(values))
    alone = []
    for regime in range(2):
        roots = [np.log(np.maximum(np.arange(2) == regime, 1e-300))]
        alone.append(MultiplePca.statistics(model | {"shares": np.exp(roots[0])}, values[:1]))
    mixture = Mixture(*(model[name] for name in Mixture._fields))
    z = (values[0] - model["centre"]) / model["scale"]
    m = mixture.memberships((z @ model["plane"])[None])[0]
    assert MultiplePca.statistics(model, values[:1]) == pytest.approx(m[0] * alone[0] + m[1] * alone[1], rel=1e-6)


def test_a_row_of_a_batch_is_compared_with_the_mean_course_at_its_stage() -> None:
    """Batches with rows at the stages only: mean and standard deviation are those of the rows of a stage."""
    rng = np.random.default_rng(14)
    share = np.tile(np.linspace(0.0, 1.0, STAGES + 1), 30)
    courses = np.column_stack([share**2, np.sin(5.0 * share), -share])
    values = np.column_stack([share, courses + 0.1 * rng.standard_normal((len(share), 3))])
    model = MultiwayPca.fit(values, baseline_of(values))
    unfolded = values.reshape(30, STAGES + 1, 4)[:, :, 1:]
    z = ((unfolded - unfolded.mean(axis=0)) / unfolded.std(axis=0)).reshape(-1, 3)
    sizes, axes = np.linalg.eigh(z.T @ z / len(z))
    scores = z @ axes
    expected = np.column_stack([np.mean(scores[:, 1:] ** 2 / sizes[1:], axis=1), scores[:, 0] ** 2 / sizes[0]])
    found = np.array([MultiwayPca.statistics(model, row[None]) for row in values[:60]])
    assert found == pytest.approx(expected[:60], rel=1e-5, abs=1e-6)


def test_held_out_blocks_are_of_whole_batches_and_few_batches_are_refused() -> None:
    values = in_batches(15, 700)
    baseline = baseline_of(values)
    starts = batch_starts(values[:, 0])
    assert values[starts, 0] == pytest.approx(0.0)
    edges = MultiwayPca.edges(baseline)
    assert len(edges) == 6
    assert set(edges[:-1]) <= set(starts)
    assert MultiwayPca.obstacle(baseline) == ""
    few = MultiwayPca.obstacle(baseline_of(values[: starts[6]]))
    assert few == "the training has 6 batches, 10 are needed (the progress falls between batches)"
