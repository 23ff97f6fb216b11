"""A sensor that sticks is recognised within a few readings, and one that repeats by nature is not called stuck."""

from math import inf, nan

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal, stats

from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.stuck import SMALLEST, StuckSensors, longest_ordinary_run, upper_bound

Array = NDArray[np.float64]
ARL0 = 432_000.0  # 30 days of 6 s


class Sensor:
    """The check of one signal without a stated resolution."""

    def __init__(self, memory: StuckSensors | None = None) -> None:
        self.memory = StuckSensors.of(1) if memory is None else memory

    @property
    def limit(self) -> float:
        return float(self.memory.numbers["limit"][0])

    def update(self, value: float) -> Judgement:
        self.memory.update(np.array([value]), np.zeros(1))
        return self.memory.judge(0)


def trained(readings: Array, arl0: float = ARL0) -> Sensor:
    sensor = Sensor()
    sensor.memory.learn(0, readings, arl0)
    return sensor


def found_at(stuck: Sensor, value: float, most: int = 1000) -> int | None:
    """How many readings of a value it takes, the first one included."""
    return next((count for count in range(1, most + 1) if stuck.update(value).out), None)


def runs_of(readings: Array) -> dict[int, int]:
    """How many runs had so many repeats, by numpy."""
    edges = np.flatnonzero(np.diff(readings) != 0)
    repeats = np.diff(np.concatenate([[-1], edges, [readings.size - 1]])) - 1
    return {int(length): int(count) for length, count in zip(*np.unique(repeats, return_counts=True), strict=True)}


def readings_of(repeated: NDArray[np.bool_]) -> Array:
    """A signal that repeats its last value where it is said."""
    return np.cumsum(np.concatenate([[1.0], np.where(repeated, 0.0, 1.0)]))


def slow_and_coarse(seed: int, rows: int, slowness: float, resolution: float) -> Array:
    """A first-order autoregressive signal of variance 1, read in steps."""
    noise = np.random.default_rng(seed).normal(size=rows + 3000) * np.sqrt(1 - slowness**2)
    values = signal.lfilter([1.0], [1.0, -slowness], noise)[3000:]
    return np.asarray(np.round(values / resolution))


# --- what is recognised --------------------------------------------------------------------------------------


def test_a_noisy_signal_that_freezes_is_recognised_at_the_fifth_equal_reading() -> None:
    noise = np.random.default_rng(1).normal(438.5, 0.3, 1001)
    stuck = trained(noise[:1000])
    stuck.update(float(noise[1000]))
    assert [stuck.update(440.0).out for _ in range(7)] == [False] * 4 + [True] * 3
    assert not stuck.update(440.1).out


def test_the_statistic_counts_equal_readings_and_the_limit_is_the_most_that_are_allowed() -> None:
    stuck = trained(np.random.default_rng(1).normal(size=1000))
    judged = [stuck.update(value) for value in (1.0, 1.0, 1.0, 2.0, 2.0)]
    assert [judgement.statistic for judgement in judged] == [1.0, 2.0, 3.0, 1.0, 2.0]
    assert {judgement.upper_limit for judgement in judged} == {stuck.limit} == {SMALLEST - 1.0}


def test_a_coarse_noisy_signal_may_repeat_itself_and_freezes_all_the_same() -> None:
    readings = np.round(np.random.default_rng(2).normal(size=3000) / 0.3)  # noise of three steps: one in nine repeats
    stuck = trained(readings[:1000])
    assert not any(stuck.update(value).out for value in readings[1000:].tolist())
    taken = found_at(stuck, 99.0)
    assert taken is not None
    assert SMALLEST < taken <= 20


def test_missing_samples_between_equal_readings_do_not_excuse_them() -> None:
    stuck = trained(np.random.default_rng(1).normal(size=1000))
    for value in (3.0, 3.0, nan, 3.0, nan, 3.0):
        assert not stuck.update(value).out
    assert stuck.update(3.0).out


def test_after_a_restart_the_count_of_equal_readings_starts_again() -> None:
    noise = np.random.default_rng(1).normal(size=1020).tolist()
    stuck = trained(np.array(noise[:1000]))
    for _ in range(4):
        stuck.update(3.0)
    stuck.memory.restart()
    assert [stuck.update(3.0).statistic for _ in range(3)] == [1.0, 2.0, 3.0]
    for value in noise[1000:]:
        stuck.update(value)
    assert found_at(stuck, 3.0) == SMALLEST


def test_a_sensor_that_sticks_while_the_plant_is_calmer_than_in_the_training_is_recognised() -> None:
    generator = np.random.default_rng(8)
    lively = np.cumsum(generator.normal(size=1000)) + generator.normal(size=1000)
    stuck = trained(lively)
    calm = generator.normal(scale=0.3, size=100).tolist()
    assert not any(stuck.update(value).out for value in calm)
    assert found_at(stuck, calm[-1]) == SMALLEST - 1  # the last that it measured is the first


# --- what is not a fault -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "readings", [np.full(1000, 438.54), np.repeat([1.0, 2.0, 3.0], 400), np.zeros(0), np.arange(10.0)]
)
def test_a_signal_that_rests_in_its_training_or_has_a_short_one_is_not_judged(readings: Array) -> None:
    stuck = trained(readings)
    assert stuck.limit == inf
    assert found_at(stuck, 5.0, most=5000) is None


def test_a_plant_without_noise_that_comes_to_rest_is_not_stuck_but_one_that_stops_short_is() -> None:
    def settled(level: float, rows: int) -> list[float]:
        """From 0 towards a level, with a time constant of five rows."""
        return [level * (1 - 0.8**row) for row in range(rows)]

    training = [offset + value for offset, level in enumerate((3.0, -2.0) * 20) for value in settled(level, 25)]
    assert len(set(settled(5.0, 400))) < 250  # at rest it is at rest to the last bit
    resting = trained(np.array(training))
    assert resting.limit == SMALLEST - 1.0
    assert not any(resting.update(value).out for value in settled(5.0, 400))
    stopped = trained(np.array(training))
    assert not any(stopped.update(value).out for value in settled(5.0, 12))
    assert found_at(stopped, settled(5.0, 12)[-1]) == SMALLEST - 1  # the last that it measured is the first


def test_a_coarse_signal_that_hardly_steps_any_more_has_come_to_rest() -> None:
    stuck = trained(np.arange(1000.0) % 7)
    resting = np.repeat(np.arange(40.0), [1, 2, 3, 4, 4, 4] + [12] * 34)  # from a step a reading to one in twelve
    assert not any(stuck.update(value).out for value in resting.tolist())


def test_a_plant_without_noise_that_restarts_at_rest_is_not_stuck() -> None:
    stuck = trained(np.sin(np.arange(1000.0)))
    assert stuck.limit == SMALLEST - 1.0
    stuck.memory.restart()
    assert found_at(stuck, 0.5) is None


def test_a_run_as_long_as_the_longest_of_the_training_is_no_fault() -> None:
    readings = np.random.default_rng(3).normal(size=1000)
    for start in (100, 400, 700):  # three runs of twelve readings
        readings[start : start + 12] = readings[start]
    stuck = trained(readings)
    assert 12 < stuck.limit < 100
    assert found_at(stuck, 5.0, most=int(stuck.limit)) is None
    assert stuck.update(5.0).out


# --- the promise ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("successes", "trials"), [(0, 1000), (3, 50), (700, 1000)])
def test_an_upper_bound_is_where_so_few_successes_have_the_probability_left_over(successes: int, trials: int) -> None:
    assert stats.binom.cdf(successes, trials, upper_bound(successes, trials, 0.95)) == pytest.approx(0.05, rel=1e-9)


@pytest.mark.parametrize("probability", [0.001, 0.02, 0.1, 0.5, 0.8])
def test_independent_repeats_keep_the_run_length_in_95_trainings_of_100(probability: float) -> None:
    """Feller (1968), vol. 1, XIII.7: the first run of k successes takes (1 - p^k) / (q p^k) trials in the mean."""
    generator, kept = np.random.default_rng(4), 0
    for _ in range(200):
        k = longest_ordinary_run(
            runs_of(readings_of(generator.random(800) < probability)), ARL0
        )  # k repeats are one too many
        kept += k == inf or (1 - probability**k) / ((1 - probability) * probability**k) >= ARL0
    assert kept >= 190


@pytest.mark.parametrize(("first", "next_one"), [(0.05, 0.6), (0.1, 0.9), (0.3, 0.5)])
def test_repeats_that_come_in_runs_keep_the_run_length_in_95_trainings_of_100(first: float, next_one: float) -> None:
    """A Markov chain: e_0 = (1/first + (1 - t) / (1 - next)) / t, t = next^(k-1), by first-step analysis."""
    generator, kept, judged = np.random.default_rng(5), 0, 0
    for _ in range(100):
        draws, repeated = generator.random(1500), np.zeros(1500, dtype=np.bool_)
        for row in range(1, 1500):
            repeated[row] = draws[row] < (next_one if repeated[row - 1] else first)
        k = longest_ordinary_run(runs_of(readings_of(repeated)), ARL0)
        rest = next_one ** (k - 1)
        kept += k == inf or (1 / first + (1 - rest) / (1 - next_one)) / rest >= ARL0
        judged += k < inf
    assert kept >= 95
    assert judged >= 95


@pytest.mark.parametrize(("share", "calm"), [(0.05, 0.95), (0.02, 0.97)])
def test_long_runs_that_are_few_among_short_ones_keep_the_run_length_in_95_trainings_of_100(
    share: float, calm: float
) -> None:
    """Most go on with probability 0.3, a share of them with `calm`: P(R >= k) = (1 - share) 0.3^k + share calm^k."""
    generator, kept, judged = np.random.default_rng(9), 0, 0
    mean = 1 + (1 - share) * 0.3 / 0.7 + share * calm / (1 - calm)  # readings in a run
    for _ in range(100):
        among = generator.random(2000) < share
        repeats = generator.geometric(np.where(among, 1 - calm, 0.7)) - 1
        runs = {int(length): int(count) for length, count in zip(*np.unique(repeats, return_counts=True), strict=True)}
        k = longest_ordinary_run(runs, ARL0)
        kept += k == inf or mean / ((1 - share) * 0.3**k + share * calm**k) >= ARL0
        judged += k < inf
    assert kept >= 95
    assert judged >= 95


@pytest.mark.parametrize(("slowness", "resolution"), [(0.0, 1.0), (0.9, 0.3), (0.9, 1.0), (0.99, 0.3), (0.99, 1.0)])
def test_slow_coarse_signals_are_called_stuck_no_more_often_than_promised(slowness: float, resolution: float) -> None:
    """Their repeats are no Markov chain: they rest longer in the middle of a step. 1.5 million readings."""
    arl0, runs_beyond, watched = 20_000.0, 0, 0
    for seed in range(30):
        readings = slow_and_coarse(seed, 51_000, slowness, resolution)
        limit = longest_ordinary_run(runs_of(readings[:1000]), arl0)
        runs_beyond += sum(count for repeats, count in runs_of(readings[1000:]).items() if repeats + 1 > limit)
        watched += 50_000
    expected = watched / arl0
    assert runs_beyond <= expected + 2 * np.sqrt(expected)


def test_the_limit_is_what_the_formula_gives_with_bounds_by_another_library() -> None:
    """Few long runs among many short ones: the line of the depth just beyond the short ones asks for most."""
    runs = {0: 4000, 1: 1000, 2: 300, 3: 100, 200: 3, 300: 4, 400: 3}
    readings, long_runs, beyond_4 = 4000 + 2000 + 900 + 400 + 3010, 10, 3000 - 4 * 10
    share = stats.beta.ppf(0.975, long_runs + 1, readings - long_runs)
    goes_on = stats.beta.ppf(0.975, beyond_4 + 1, long_runs)
    assert longest_ordinary_run(runs, ARL0) == 4 + np.ceil(np.log(ARL0 * share) / -np.log(goes_on))


def test_more_false_alarms_allowed_is_never_a_longer_limit() -> None:
    runs = runs_of(slow_and_coarse(1, 2000, 0.99, 0.3))
    limits = [longest_ordinary_run(runs, arl0) for arl0 in (1e2, 1e3, 1e4, 1e6, 1e9)]
    assert limits == sorted(limits)
    assert limits[0] < limits[-1]


def test_the_training_counts_runs_as_numpy_does() -> None:
    readings = slow_and_coarse(6, 3000, 0.9, 1.0)
    assert trained(readings).limit == longest_ordinary_run(runs_of(readings), ARL0)


# --- memory --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cut", [0, 1, 5, 499, 500])
def test_a_check_that_resumes_from_its_memory_judges_as_one_that_never_stopped(cut: int) -> None:
    readings = slow_and_coarse(7, 1000, 0.9, 1.0).tolist() + [9.0] * 60
    through, stopped = (trained(np.array(readings[:500]), 1e4) for _ in range(2))
    expected = [through.update(value) for value in readings[500:]]
    before = [stopped.update(value) for value in readings[500 : 500 + cut]]
    resumed = Sensor(StuckSensors.from_bytes(stopped.memory.to_bytes()))
    resumed.memory.place(StuckSensors.of(1).numbers)
    assert before + [resumed.update(value) for value in readings[500 + cut :]] == expected
    assert resumed.memory.to_bytes() == through.memory.to_bytes()


def test_a_memory_that_cannot_be_is_refused() -> None:
    """One of another number of signals, and one whose count of steps would lead a kernel beyond them."""
    with pytest.raises(ValueError, match="there must be 1 records of"):
        StuckSensors.of(2).place(StuckSensors.of(1).numbers)
    damaged = StuckSensors.of(1)
    damaged.numbers["step_count"] = 9
    with pytest.raises(ValueError, match="at most 8 steps"):
        damaged.place(StuckSensors.of(1).numbers)


@pytest.mark.parametrize("arl0", [1.0, inf, nan])
def test_a_run_length_that_is_none_is_refused(arl0: float) -> None:
    with pytest.raises(InputError, match=r"arl0 must be a number above 1"):
        trained(np.arange(20.0), arl0)
