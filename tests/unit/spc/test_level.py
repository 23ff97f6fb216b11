"""The chart of levels: its run length, its limit after a short training, and that its alarm stands."""

import numpy as np
import pytest
from scipy import signal, special

from reactorwatch.spc.charts.level import Level
from reactorwatch.spc.charts.value_chart import ValueBaseline
from reactorwatch.spc.slow_levels import MEMORIES, SlowLevels, crossing_rate

from .members import Array

ARL0, ROWS, PHI = 20_000.0, 20_000, 0.985


def wandering(rng: np.random.Generator, rows: int, signals: int, phi: float = PHI) -> Array:
    """Autoregressive signals of standard deviation 1, shape (rows, signals)."""
    steps = rng.standard_normal((rows + 1000, signals)) * np.sqrt(1.0 - phi**2)
    return np.asarray(signal.lfilter([1.0], [1.0, -phi], steps, axis=0)[1000:])


def baseline_of(values: Array, inputs: int = 0) -> ValueBaseline:
    """A training, whose outputs together have a false alarm in `ARL0` rows."""
    names = tuple(f"s{i}" for i in range(values.shape[1]))
    return ValueBaseline(names, values, ARL0 * (len(names) - inputs), {"level_weight": 0.1}, inputs=inputs)


def statistics(chart: Level, values: Array) -> Array:
    """Statistic of each row over the limit."""
    return np.array([chart.update(row).statistic for row in values]) / chart.limit


def test_crossings_are_those_of_independent_values_and_of_the_formula_of_rice() -> None:
    beyond = 2.0 * special.ndtr(-3.5)
    assert crossing_rate(np.array(3.5), np.array(2.0)) == pytest.approx(beyond * (1.0 - 0.5 * beyond), rel=1e-9)
    rice = np.sqrt(1e-4) / np.pi * np.exp(-0.5 * 3.5**2)  # 2 crossings outwards in each period, of two limits
    assert crossing_rate(np.array(3.5), np.array(1e-4)) == pytest.approx(rice, rel=1e-3)


@pytest.mark.parametrize(
    ("signals", "rows", "phi"), [(1, 1000, PHI), (1, 3400, PHI), (9, 1000, PHI), (1, 3400, 0.995), (1, 1000, 0.5)]
)
def test_false_alarms_after_a_training_are_at_most_those_promised(signals: int, rows: int, phi: float) -> None:
    """Simulated, on average over trainings; one excursion is one alarm. Not too few: a limit costs sensitivity."""
    rng, found, plants = np.random.default_rng(7), 0.0, 200
    for _ in range(plants):
        values = wandering(rng, rows + ROWS, signals, phi)
        chart = Level.design(baseline_of(values[:rows]))
        averages = signal.lfilter([0.1], [1.0, -0.9], values[rows:] - chart._centres, axis=0)
        out = np.flatnonzero(np.max(np.abs(averages) / chart._scales, axis=1) > chart.limit)
        found += float(1 + np.count_nonzero(np.diff(out) > 20)) if out.size else 0.0
    promised = plants * ROWS / ARL0
    assert 0.05 * promised < found < 1.2 * promised


@pytest.mark.parametrize("signals", [1, 9])
def test_memories_have_the_weight_that_the_training_gives_them(signals: int) -> None:
    """The weighted mean of their logarithm is that of the correlation which averages have after 19 rows."""
    rng, phi, kept = np.random.default_rng(3), 0.99, 0.9
    exact = (phi**20 * (1 - kept**2) - kept**20 * (1 - phi**2)) / ((phi - kept) * (1 + phi * kept))
    found = [SlowLevels.of(wandering(rng, 5700, signals, phi), 0, 0.1) for _ in range(12)]
    memories = np.geomspace(0.2, 0.5 * 299, MEMORIES)
    mean = np.exp(np.mean([np.log(memories) @ item.weights for item in found]))
    assert mean == pytest.approx(-1.0 / np.log(exact), rel=0.2)


def test_a_fall_is_out_until_the_signal_is_back_and_values_may_be_missing() -> None:
    rng = np.random.default_rng(4)
    values = wandering(rng, 3400, 2)
    chart, falls = Level.design(baseline_of(values)), np.interp(np.arange(1500), [100, 400, 1000, 1100], [0, 12, 12, 0])
    rows = wandering(rng, 1500, 2)
    rows[:, 1] -= falls
    rows[300:900:7, 0] = np.nan
    out = np.array([chart.update(filled).out for row in rows if (filled := chart.fill(row)) is not None])
    assert out.size == 1500
    assert not out[:150].any()
    assert out[300:1000].all()
    assert not out[1200:].any()
    assert chart.fill(np.full(2, np.nan)) is None


def driven(rng: np.random.Generator, inputs: Array, lag: float, fall: Array | float = 0.0) -> Array:
    """Rows of an input and of an output that follows it with a lag, wanders by itself, and falls."""
    follows = signal.lfilter([1.0 / lag], [1.0, 1.0 / lag - 1.0], inputs)
    return np.column_stack([inputs, 5.0 + 2.0 * follows + 0.3 * wandering(rng, inputs.size, 1)[:, 0] - fall])


def test_a_limit_is_not_below_that_of_a_normal_process_with_the_largest_level_of_the_training() -> None:
    """Independent values: the normal quantiles of both rates, for the true standard deviation of the averages."""
    rng = np.random.default_rng(13)
    values = rng.standard_normal((4000, 1))
    values[2000:2004] += 30.0
    levels = SlowLevels.of(values, 0, 0.1)
    assert levels.largest == pytest.approx(30.0 * (1.0 - 0.9**4), rel=0.1)
    ratio = np.array([levels.limits(run_length)[0] for run_length in (1e4, 1e6)]) / levels.largest
    step = float((levels.steps / levels.sds**2)[0])
    for run_length, found in zip((1e4, 1e6), ratio, strict=True):
        rates = np.array([run_length, 4000.0])
        exact = np.sqrt(2.0 * np.log(rates * np.sqrt(step) / np.pi))  # of the formula of Rice
        assert found == pytest.approx(exact[0] / exact[1], rel=0.02)


@pytest.mark.parametrize("phi", [PHI, 0.5])
def test_a_bias_of_the_stated_reach_is_out_in_nine_of_ten_cases(phi: float) -> None:
    """In the last row; before, a signal that forgets sooner than the average has further chances."""
    rng, seen = np.random.default_rng(14), list[bool]()
    for _ in range(100):
        baseline = baseline_of(wandering(rng, 1000, 1, phi))
        chart, reach = Level.design(baseline), Level.reaches(baseline)["s0"]
        for _ in range(10):
            seen.append(bool(statistics(chart, reach + wandering(rng, 100, 1, phi))[-1] > 1.0))
            chart.restart()
    assert 0.87 < np.mean(seen) < 0.97


def test_while_an_output_is_missing_its_level_follows_the_inputs() -> None:
    rng = np.random.default_rng(12)
    rows = driven(rng, np.repeat(rng.uniform(-1.0, 1.0, 75), 40), 20.0)
    chart = Level.design(baseline_of(rows[:2000], inputs=1))
    before = statistics(chart, rows[2000:2500])[-1]
    rows[2500:2900, 1] = np.nan
    found = [chart.update(filled).statistic for row in rows[2500:2900] if (filled := chart.fill(row)) is not None]
    assert np.max(found) / chart.limit < 1.1 * before  # of which the limit's width takes some


@pytest.mark.parametrize("lag", [10.0, 25.0, 60.0])
def test_an_output_that_follows_its_input_to_a_new_level_is_not_outside_and_one_that_falls_is(lag: float) -> None:
    """The input is held at the edge of what it was for 40 times as long as ever in the training."""
    rng = np.random.default_rng(8)
    held = np.repeat(rng.uniform(-1.0, 1.0, 100), 40)
    chart = Level.design(baseline_of(driven(rng, held[:2000], lag), inputs=1))
    held[2400:] = 1.0
    assert statistics(chart, driven(rng, held[2000:], lag)).max() < 1.0
    chart.restart()
    falls = np.interp(np.arange(2000), [500, 1000], [0.0, 5.0])
    found = statistics(chart, driven(rng, held[2000:], lag, falls))
    assert found[:500].max() < 1.0
    assert found[1000:].min() > 1.0
    text, shares = chart.explain()
    assert text.startswith("outside its training: s1 is on average ")
    assert "allowed with these inputs" in text
    assert shares == {"s1": 1.0}


def test_beyond_the_inputs_of_the_training_the_limit_grows_with_the_square_of_the_distance() -> None:
    rng = np.random.default_rng(9)
    chart = Level.design(baseline_of(driven(rng, np.repeat(rng.uniform(-1.0, 1.0, 50), 40), 10.0), inputs=1))
    reached = []
    for x in (1.5, 3.0, 6.0):
        chart.restart()
        for _ in range(2000):
            found = chart.update([x, 105.0 + x * chart._gains.sum()]).statistic
        reached.append(100.0 / found)  # one unit, where a level of 100 is unexplained
    assert reached[1] / reached[0] > 3.5
    assert reached[2] / reached[1] > 3.5


def test_after_a_start_the_limit_allows_for_inputs_before_it() -> None:
    rng = np.random.default_rng(11)
    held = np.repeat(rng.uniform(-1.0, 1.0, 75), 40)
    rows = driven(rng, held, 100.0)
    chart = Level.design(baseline_of(rows[:2000], inputs=1))
    statistics(chart, rows[2000:])
    running = statistics(chart, rows[2500:2600])
    chart.restart()
    assert np.all(statistics(chart, rows[2500:2510]) < 0.9)
    assert running.max() < 1.0


def test_a_training_too_short_for_slow_changes_is_refused() -> None:
    rng = np.random.default_rng(10)
    short = Level.obstacle(baseline_of(wandering(rng, 200, 2), inputs=1))
    assert short == "the training has 200 rows with all signals, 247 are needed for slow changes"
    assert Level.obstacle(baseline_of(wandering(rng, 247, 2), inputs=1)) == ""


@pytest.mark.parametrize("phi", [0.0, 0.9, PHI])
def test_a_hundredth_of_sound_rows_is_away(phi: float) -> None:
    """Simulated, on average over trainings; rather fewer, as the memory is uncertain."""
    rng, shares = np.random.default_rng(11), []
    for _ in range(100):
        values = wandering(rng, 1000 + ROWS, 1, phi)
        chart = Level.design(baseline_of(values[:1000]))
        averages = signal.lfilter([0.1], [1.0, -0.9], values[1000:] - chart._centres, axis=0)
        shares.append(np.mean(np.abs(averages) > chart.limit * chart._scales * chart.memory.back))
    assert 0.003 < np.mean(shares) < 0.013


def test_an_output_is_away_until_its_level_is_back() -> None:
    rng = np.random.default_rng(12)
    values = wandering(rng, 1500, 2, 0.5)
    values[1100:1300, 1] += 8.0
    chart, away = Level.design(baseline_of(values[:1000])), []
    for row in values[1000:]:
        chart.update(row)
        away.append(chart.away)
    assert all("s1" in names for names in away[110:300])
    assert not any("s1" in names for names in away[330:360])
