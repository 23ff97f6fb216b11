"""Rows of one period from irregular ones: means over the time of a row, held values, gaps; held to closed forms."""

import numpy as np
import pytest
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import METHODS, FileFormat
from reactorwatch.records.record import Record, join_runs
from reactorwatch.records.resampling import is_by_exception, resample

S = 1 / 60.0
"""Minutes in a second."""

Array = NDArray[np.float64]


def make_rows(record: Record, rule: str, **roles: str) -> Record:
    stated = FileFormat(resample=rule).resample_rule
    assert stated is not None
    return resample(record, stated, roles)


def table(**signals: tuple[Array, Array]) -> Record:
    """A record of signals with times of their own, in seconds."""
    times: Array = np.unique(np.concatenate([own for own, _ in signals.values()]))
    columns = {name: np.full(times.size, np.nan) for name in signals}
    for name, (own, values) in signals.items():
        columns[name][np.searchsorted(times, own)] = values
    return Record(times * S, columns, "export")


def reports(values: Array, deadband: float, longest: int | None = None) -> NDArray[np.intp]:
    """Numbers of the values that are reported by exception, or when the longest silence has passed."""
    kept = [0]
    for number, value in enumerate(values):
        is_due = longest is not None and number - kept[-1] >= longest
        if abs(value - values[kept[-1]]) >= deadband or is_due:
            kept.append(number)
    return np.array(kept)


@pytest.mark.parametrize("method", ["", *(f",{name}" for name in METHODS)])
@pytest.mark.parametrize("period", ["6 s", "auto"])
def test_regular_rows_of_the_period_stay_as_they_are_to_the_last_bit(period: str, method: str) -> None:
    rng = np.random.default_rng(1)
    columns = {name: rng.normal(350.0, 5.0, 500) for name in ("T", "u")}
    excluded = np.full(500, np.nan)
    columns["T"][[40, 41, 300]], excluded[[40, 41, 300]] = np.nan, -999.0
    record = Record(np.arange(500) / 10 + 7.3, columns, "export", excluded={"T": excluded})
    rows = make_rows(record, period + method, u="input")
    np.testing.assert_allclose(rows.time_min, record.time_min, rtol=0, atol=1e-12)
    for name, values in columns.items():
        np.testing.assert_array_equal(rows.columns[name], values)
    np.testing.assert_array_equal(rows.excluded["T"], excluded)


@pytest.mark.parametrize("offset_s", [0.0, 0.3, 0.9])
def test_the_mean_of_a_ramp_is_its_value_at_the_time_of_the_row(offset_s: float) -> None:
    """Ten values a row, not in step with the rows: a mean of those after the row's time alone is half a sample late."""
    fast, other = offset_s + np.arange(1200.0), np.arange(0.0, 1200.0, 10.0)
    rows = make_rows(table(T=(fast, 5.0 * fast), level=(other, 0 * other)), "10 s")
    found = rows.columns["T"] / 5.0 - rows.time_min / S
    assert np.isnan(found[[0, -1]]).any()  # where half of the period has no values
    np.testing.assert_allclose(found[1:-1], 0.0, atol=1e-9)


def test_the_mean_of_a_ramp_at_random_times_is_late_by_less_than_a_tenth_of_the_spacing() -> None:
    times = np.cumsum(np.random.default_rng(2).exponential(1.0, 20_000))
    rows = make_rows(table(T=(times, times)), "10 s")
    error_s = rows.columns["T"] - rows.time_min / S
    assert abs(np.nanmean(error_s)) < 0.01
    assert np.nanstd(error_s) < 0.1


def test_many_values_in_a_short_time_weigh_no_more_than_one() -> None:
    """Seconds 0 to 5 have 51 values of 1, seconds 5 to 10 one value of 0 at 10 s: it stands for half of the way."""
    burst = np.arange(0.0, 5.05, 0.1)
    times = np.concatenate([burst, 10.0 + 10.0 * np.arange(30)])
    values = np.concatenate([np.ones(burst.size), np.zeros(30)])
    rows = make_rows(table(y=(times, values)), "10 s,mean")
    at_10_s = np.flatnonzero(np.isclose(rows.time_min, 10 * S))
    assert rows.columns["y"][at_10_s] == pytest.approx(0.25)  # from 5 s to 7.5 s the last value of the burst


def test_an_input_is_averaged_over_the_time_for_which_its_row_holds_it() -> None:
    """It steps from 1 to 3 at 30 % of the row that begins at 50 s."""
    times = np.arange(0.0, 200.0, 0.5)
    record = table(u=(times, np.where(times < 53.0, 1.0, 3.0)), y=(times, times))
    rows = make_rows(record, "10 s", u="input")
    np.testing.assert_allclose(rows.columns["u"][[4, 5, 6]], [1.0, 0.3 * 1.0 + 0.7 * 3.0, 3.0])


def test_what_is_reported_by_exception_is_held_however_long_it_is_silent() -> None:
    rng = np.random.default_rng(3)
    seconds = np.arange(0.0, 20_000.0, 2.0)
    level = np.cumsum(rng.normal(scale=0.1, size=seconds.size))
    kept = reports(level, 1.0)
    kept = kept[(kept < 3000) | (kept > 6000)]  # silent for 100 min
    moves, inputs = np.array([0.0, 700.0, 950.0, 4000.0]), np.array([1.0, 4.0, 2.0, 3.0])
    noise = rng.normal(size=seconds.size)
    record = table(T=(seconds, noise), L=(seconds[kept], level[kept]), u=(moves, inputs))
    rows = make_rows(record, "auto", u="input")
    assert rows.read_as.endswith("(median spacing of T): T mean, L last (held between), u mean (held between)")
    expected = level[kept][np.searchsorted(kept, np.arange(seconds.size), side="right") - 1]
    np.testing.assert_array_equal(rows.columns["L"], expected)
    np.testing.assert_array_equal(rows.columns["u"], inputs[np.searchsorted(moves, seconds, side="right") - 1])


def wandering(rng: np.random.Generator) -> Array:
    """First-order autoregression of unit variance with a memory of 65 values."""
    values = np.zeros(6000)
    for row, shock in enumerate(rng.normal(scale=np.sqrt(1 - 0.985**2), size=5999)):
        values[row + 1] = 0.985 * values[row] + shock
    return values


@pytest.mark.parametrize("deadband", [0.2, 0.5])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_reports_by_exception_are_recognised_also_with_noise_or_a_longest_silence(
    deadband: float, noise: float
) -> None:
    rng = np.random.default_rng(5)
    for longest in (None, 300):
        values = wandering(rng) + noise * rng.normal(size=6000)
        kept = reports(values, deadband, longest)[:400]
        assert is_by_exception([(kept.astype(float), values[kept])])


@pytest.mark.parametrize("resolution", [0.0, 0.1])
def test_samples_at_random_times_are_not_taken_for_reports_by_exception(resolution: float) -> None:
    """White noise and one with a long memory: of a hundred records each none, and one by chance."""
    rng, found = np.random.default_rng(4), 0
    for values in [rng.normal(size=6000) for _ in range(100)] + [wandering(rng) for _ in range(100)]:
        at = np.flatnonzero(rng.random(6000) < 0.1)[: rng.integers(60, 400)]
        shown = np.round(values[at] / resolution) * resolution if resolution else values[at]
        found += is_by_exception([(at.astype(float), shown)])
    assert found <= 1


def test_a_slower_output_has_a_value_in_its_own_rows_alone_unless_another_method_is_asked_for() -> None:
    fast, lab = np.arange(0.0, 18_000.0, 10.0), np.arange(5.0, 18_000.0, 300.0)
    record = table(T=(fast, fast), C=(lab, lab))
    rows = make_rows(record, "10 s")
    known = np.flatnonzero(~np.isnan(rows.columns["C"]))
    np.testing.assert_array_equal(known, np.arange(1, 1800, 30))
    assert rows.read_as == "resampled to 10 s: T mean, C sparse (empty between)"
    held, line = make_rows(record, "10 s,C=mean"), make_rows(record, "10 s,C=interpolated")
    assert held.read_as == "resampled to 10 s: T mean, C mean (the nearest value between)"
    nearest = np.abs(rows.time_min[:, None] / S - lab).argmin(axis=1)
    np.testing.assert_array_equal(held.columns["C"][1:1750], lab[nearest][1:1750])
    np.testing.assert_allclose(line.columns["C"][1:1750], fast[1:1750])


def test_a_signal_slower_than_all_rows_that_are_asked_for_is_held_as_nothing_else_is_there() -> None:
    times = np.cumsum(np.random.default_rng(5).choice([5.0, 15.0, 25.0], 400))
    rows = make_rows(table(y=(times, np.sin(times))), "5 s")
    assert rows.read_as == "resampled to 5 s: y mean (the nearest value between)"
    assert not np.isnan(rows.columns["y"]).any()
    np.testing.assert_allclose(np.diff(rows.time_min), 5 * S)


@pytest.mark.parametrize(("missing_s", "is_gap"), [(40.0, False), (400.0, True)])
def test_a_long_gap_stays_a_gap_and_a_short_one_is_bridged(missing_s: float, *, is_gap: bool) -> None:
    times = np.arange(0.0, 2000.0, 10.0)
    times = times[(times <= 1000.0) | (times >= 1000.0 + missing_s)]
    rows = make_rows(table(y=(times, times)), "10 s")
    assert bool(np.diff(rows.time_min).max() > 11 * S) is is_gap
    assert rows.read_as.endswith("1 gap left") is is_gap


def test_a_gap_of_one_signal_is_judged_by_its_own_spacing() -> None:
    """A value each 300 s is held for five of its own spacings, not for five rows of the other signal."""
    fast, slow = np.arange(0.0, 30_000.0, 10.0), np.arange(0.0, 30_000.0, 300.0)
    fast, slow = fast[(fast < 9000) | (fast >= 9600)], slow[(slow < 12_000) | (slow >= 15_000)]
    rows = make_rows(table(T=(fast, fast), C=(slow, slow)), "10 s,mean")
    seconds = np.round(rows.time_min / S)
    assert np.isnan(rows.columns["T"][(seconds > 9100) & (seconds < 9500)]).all()
    assert not np.isnan(rows.columns["C"][(seconds > 9100) & (seconds < 11_700)]).any()
    assert np.isnan(rows.columns["C"][(seconds > 12_000) & (seconds < 14_700)]).all()


def test_a_code_is_never_averaged_and_each_run_has_rows_of_its_own() -> None:
    times = np.arange(0.0, 600.0, 1.0)
    run = table(y=(times, times), mode=(times, np.floor(times / 25.0)))
    rows = make_rows(join_runs([run, run]), "10 s,mean", mode="mode")
    assert set(np.unique(rows.columns["mode"])) <= set(range(25))
    assert [part.rows for part in rows.split_runs()] == [rows.rows // 2] * 2


@pytest.mark.parametrize(
    ("rule", "error"),
    [
        ("fast", "--resample must be a positive number with its unit, such as 4 s, or auto, got 'fast'"),
        ("auto,median", "unknown --resample: method 'median'"),
        ("auto,Z=last", "export: --resample: unknown signal 'Z' (valid: y)"),
        ("1 ns", "makes more than 50,000,000 rows; state a longer one"),
    ],
)
def test_a_rule_that_cannot_be_followed_is_refused(rule: str, error: str) -> None:
    with pytest.raises(InputError) as refused:
        make_rows(table(y=(np.arange(50.0), np.arange(50.0))), rule)
    assert error in str(refused.value)
