"""Peers and scores of the outside benchmarks equal independent computations on small examples."""

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import linalg, stats
from sklearn.covariance import EmpiricalCovariance  # type: ignore[import-untyped]

from benchmarks.outside.peers import LAGS, WINDOW, CanonicalVariates, DynamicPca, Pca, cross_validated_limits
from benchmarks.outside.scores import Row, blocks_of, bootstrap_interval, compare_rows, markdown, score_change_points

Array = NDArray[np.float64]


def correlated_rows(rows: int = 600, signals: int = 5, seed: int = 1) -> Array:
    """Autoregressive rows with two common directions and noise."""
    rng = np.random.default_rng(seed)
    hidden = np.zeros((rows, 2))
    for k in range(1, rows):
        hidden[k] = 0.9 * hidden[k - 1] + rng.normal(0, 1, 2)
    return np.asarray(hidden @ rng.normal(0, 1, (2, signals)) + rng.normal(0, 0.3, (rows, signals)) + 10.0)


def test_t2_of_all_components_is_the_mahalanobis_distance() -> None:
    rows = correlated_rows()
    pca = Pca.fit(rows)
    every = Pca(pca.centre, pca.spread, pca.directions, pca.variances, len(pca.variances), pca.rows)
    distance = EmpiricalCovariance().fit(rows).mahalanobis(rows) * (len(rows) - 1) / len(rows)
    np.testing.assert_allclose(every.statistics(rows)["T2"], distance, rtol=1e-9)
    np.testing.assert_allclose(every.statistics(rows)["SPE"], 0.0, atol=1e-18)


def test_spe_is_the_squared_distance_from_the_plane_of_the_components() -> None:
    rows = correlated_rows()
    pca = Pca.fit(rows)
    scaled = (rows - rows.mean(axis=0)) / rows.std(axis=0, ddof=1)
    values, vectors = linalg.eigh(np.cov(scaled.T))
    rest = vectors[:, : len(values) - pca.kept]
    np.testing.assert_allclose(pca.statistics(rows)["SPE"], np.sum((scaled @ rest) ** 2, axis=1), rtol=1e-8)


def test_textbook_limits_keep_their_level_for_independent_normal_rows() -> None:
    """With 5,000 rows of training the limits of T2 and SPE are exceeded by 1 % of 200,000 new rows."""
    rng = np.random.default_rng(3)
    mixing = rng.normal(0, 1, (3, 8))

    def draw(count: int) -> Array:
        return np.asarray(rng.normal(0, 1, (count, 3)) @ mixing + rng.normal(0, 0.5, (count, 8)))

    pca = Pca.fit(draw(5000))
    limits = pca.textbook_limits(0.99)
    for name, values in pca.statistics(draw(200_000)).items():
        assert np.mean(values > limits[name]) == pytest.approx(0.01, abs=0.0025), name


def test_dynamic_pca_is_pca_of_the_stacked_rows() -> None:
    rows = correlated_rows()
    stacked = np.concatenate([rows[LAGS - lag : len(rows) - lag] for lag in range(LAGS + 1)], axis=1)
    found = DynamicPca.fit(rows).statistics(rows)
    for name, values in Pca.fit(stacked).statistics(stacked).items():
        np.testing.assert_allclose(found[name][LAGS:], values, rtol=1e-9)
        assert np.isnan(found[name][:LAGS]).all()


def test_canonical_variates_solve_the_generalised_eigenvalue_problem() -> None:
    """The state's directions by scipy's generalised eigenproblem of past and future, and its T2 from them."""
    rows = correlated_rows()
    model = CanonicalVariates.fit(rows)
    scaled = (rows - rows.mean(axis=0)) / rows.std(axis=0, ddof=1)
    last = len(rows) - WINDOW
    past = np.concatenate([scaled[WINDOW - 1 - i : last - i] for i in range(WINDOW)], axis=1)
    future = np.concatenate([scaled[WINDOW - 1 + i : last + i] for i in range(1, WINDOW + 1)], axis=1)
    both = np.cov(past.T, future.T)
    n = past.shape[1]
    pp, pf, ff = both[:n, :n], both[:n, n:], both[n:, n:]
    _, directions = linalg.eigh(pf @ linalg.solve(ff, pf.T), pp)
    state = directions[:, ::-1][:, : model.state.shape[1]]
    found = model.statistics(rows)
    np.testing.assert_allclose(found["Ts2"][WINDOW - 1 : last], np.sum((past @ state) ** 2, axis=1), rtol=1e-6)
    whole = np.einsum("ij,jk,ik->i", past, linalg.inv(pp), past)
    np.testing.assert_allclose((found["Ts2"] + found["Tr2"])[WINDOW - 1 : last], whole, rtol=1e-6)


def test_cross_validated_limits_are_quantiles_of_blocks_judged_by_the_others() -> None:
    rows = correlated_rows(200)
    values = []
    for block in range(4):
        part = slice(50 * block, 50 * (block + 1))
        values.append(Pca.fit(np.delete(rows, part, axis=0)).statistics(rows[part])["T2"])
    limit = cross_validated_limits(Pca, rows, 0.9, blocks=4)["T2"]
    assert limit == pytest.approx(np.quantile(np.concatenate(values), 0.9))


def test_rows_are_counted_over_all_files_together() -> None:
    truth = [np.array([True, True, False]), np.array([False, True])]
    alarm = [np.array([True, False, True]), np.array([False, True])]
    found = compare_rows(truth, alarm)
    assert (found.true_alarms, found.false_alarms, found.missed, found.sound) == (2, 1, 1, 1)
    assert found.false_alarm_percent == 50.0
    assert found.missed_percent == pytest.approx(100 / 3)
    assert found.f1 == pytest.approx(2 / 3)


@pytest.mark.parametrize(
    ("detections", "score", "missed", "false"),
    [
        ([100.0, 500.0], 100.0, 0, 0),  # at once
        ([160.0, 560.0], 100 * (2 * -0.11 + 2) / 4, 0, 0),  # at the end of the window: worth a false one
        ([130.0, 530.0], 100 * (2 * 0.445 + 2) / 4, 0, 0),  # in its middle: half way
        ([], 0.0, 2, 0),
        ([50.0], 100 * (-2 - 0.11 + 2) / 4, 2, 1),
        ([100.0, 101.0, 500.0], 100.0, 0, 0),  # a second one in the window neither counts nor costs
    ],
)
def test_change_points_have_the_value_of_the_benchmark_s_profile(
    detections: list[float], score: float, missed: int, false: int
) -> None:
    found = score_change_points([np.array([100.0, 500.0])], [np.array(detections)], 60.0)
    assert (found.missed, found.false_positives) == (missed, false)
    assert found.score == pytest.approx(score)


def test_windows_that_overlap_end_where_the_next_begins() -> None:
    found = score_change_points([np.array([0.0, 30.0])], [np.array([40.0])], 60.0)
    assert (found.missed, found.false_positives) == (1, 0)


def test_the_interval_of_a_mean_is_that_of_normal_theory_for_many_values() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(5.0, 2.0, 400)
    low, high = bootstrap_interval(values, rng)
    expected = stats.norm.interval(0.95, values.mean(), values.std(ddof=1) / 20)
    assert (low, high) == pytest.approx(expected, abs=0.03)
    np.testing.assert_allclose(blocks_of(np.array([True, False, True, True]), 2), [0.5, 1.0])


def test_a_cell_that_a_row_does_not_have_stays_empty() -> None:
    text = markdown([Row("a", "x", {"one": "1"}), Row("b", "y", {"two": "2"})])
    assert text.splitlines()[2:] == ["| a | x | 1 |  |", "| b | y |  | 2 |"]


def test_data_that_are_not_there_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from benchmarks.outside import __main__ as main
    from benchmarks.outside import tennessee

    said = main.measure_benchmark(main.Benchmark("TEP", "tep", tennessee.measure, "One record."), tmp_path)
    assert said.startswith("## TEP\n\nNot measured: ")
    assert capsys.readouterr().out == ""


def test_a_table_replaces_the_one_with_its_title_and_the_others_stay() -> None:
    from benchmarks.outside.__main__ import BEGIN, END, replace_tables

    page = f"Text.\n\n{BEGIN}\n\n## A\n\nold\n\n## B\n\nkept\n\n{END}\n"
    assert replace_tables(page, ["## A\n\nnew", "## C\n\nadded"]) == (
        f"Text.\n\n{BEGIN}\n\n## A\n\nnew\n\n## B\n\nkept\n\n## C\n\nadded\n\n{END}\n"
    )


PAGE = (Path(__file__).parents[3] / "docs" / "outside.md").read_text(encoding="utf-8")
PROSE, TABLES = PAGE.split("<!-- tables: begin -->")


def test_each_table_of_the_page_states_how_many_records_it_is_from_as_its_benchmark_does() -> None:
    from benchmarks.outside.__main__ import BENCHMARKS

    parts = {part.partition("\n")[0]: part for part in re.split(r"(?m)^## ", TABLES)[1:]}
    assert set(parts) == {item.title for item in BENCHMARKS}
    for item in BENCHMARKS:
        stamp, _, table = parts[item.title].partition("\n\n")[2].partition("\n\n")
        assert stamp.endswith(f" {item.records}"), item.title
        assert "ecord" in item.records
        assert all("one record" in name for name in re.findall(r"\| (fault [^|]*)\|", table.partition("\n")[0]))


def test_a_measured_table_states_its_records_above_it(tmp_path: Path) -> None:
    from benchmarks.outside import __main__ as main

    (tmp_path / "data").mkdir()
    benchmark = main.Benchmark("A", "data", lambda *_: [Row("a", "x", {"one": "1"})], "One record.")
    head, stamp, _ = main.measure_benchmark(benchmark, tmp_path).split("\n\n")
    assert head == "## A"
    assert stamp.endswith(". One record.")


def test_no_number_in_the_text_of_the_page_is_without_its_records() -> None:
    """A sentence with a decimal number or a percentage names the records that it is from."""
    text = PROSE.partition("## What the tables do not show")[2]
    sentences = [" ".join(item.split()) for item in re.split(r"(?<=[.:])\s+(?=[A-Z])", text)]
    measured = [item for item in sentences if re.search(r"\d\.\d|\d %|third of its rows", item)]
    assert len(measured) >= 5
    assert [item for item in measured if not re.search(r"records?\b|over seven fresh seeds|over them", item)] == []
    assert "over seven fresh seeds of the original simulator the share is 0.04" in " ".join(text.split())
