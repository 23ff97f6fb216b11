"""The linear map predicts the filters' innovations; screens of single causes, pairs and effects with states."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, Decay, FittedProfile, PiecewiseLinear, Ramp, Sine, Step
from reactorwatch.diagnosis.fitting.signatures import solve_bounded
from reactorwatch.diagnosis.result import NAMED
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.dynamic_and_pair_screens import DynamicEffectsScreen, PairScreen
from reactorwatch.diagnosis.search.screen import DECAYS, Screen
from reactorwatch.kalman.error_dynamics import ErrorDynamics
from reactorwatch.process.library.cstr import EFFECTS, cstr
from tests.unit.diagnosis.runs import make_run, record_of
from tests.unit.process.effect_named import effect_of

NOISY = Noise((0.002, 0.3), (0.001, 0.3))
NAMES = ("coolant_flow", "reaction_rate", "temperature_bias", "concentration_gain")


@pytest.fixture(scope="module")
def run() -> Run:
    return make_run(rows=600)


def fit_at(name: str, run: Run, profile: FittedProfile, parameters: Array) -> tuple[Hypothesis, Fit]:
    hypothesis = Hypothesis(FaultFilter(cstr(), (effect_of(name),), NOISY), (profile,))
    return hypothesis, hypothesis.evaluate(run, (parameters,))


def ways_of(name: str, run: Run) -> ErrorDynamics:
    hypothesis, fit = fit_at(name, run, Constant(run.time_min), np.zeros(1))
    return hypothesis.filter.error_dynamics(run, hypothesis.signals(fit), fit.innovations)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("kind", "parameters"),
    [(Constant, [1.0]), (Step, [1.0, 20.03]), (Ramp, [1.0, 15.0]), (Decay, [1.0, 10.0, 7.0]), (Sine, [0.6, 0.8, 9.0])],
)
def test_the_signature_is_what_a_small_deviation_does(
    name: str, kind: type[FittedProfile], parameters: list[float], run: Run
) -> None:
    profile, numbers = kind(run.time_min), np.array(parameters)
    interval_mean, sample_value = profile.basis_signals(numbers[profile.n_linear :])[:2]
    g = (
        signatures.forward_signatures(ways_of(name, run), 0, interval_mean[1:-1], sample_value[2:])
        @ numbers[: profile.n_linear]
    )
    scale = 0.02 / np.sqrt(np.sum(g**2))
    up, down = numbers.copy(), numbers.copy()
    up[: profile.n_linear] *= scale
    down[: profile.n_linear] *= -scale
    near = [fit_at(name, run, profile, item)[1].w[2:] for item in (down, up)]
    difference = (near[0] - near[1]) / (2.0 * scale)
    settled = slice(40, None)  # a filter begins at what a sensor shows, its bias included
    assert np.sqrt(np.mean((difference - g)[settled] ** 2)) < 0.03 * np.sqrt(np.mean(g[settled] ** 2))


@pytest.mark.parametrize("name", NAMES)
def test_backwards_sums_are_those_of_the_signatures(name: str, run: Run) -> None:
    ways = ways_of(name, run)
    step = np.diff(run.time_min[1:])
    constant = 12.0
    gamma = np.exp(-step / constant)
    beta, mean = np.stack([step, 1 - gamma]), np.stack([0.5 * step, 1 - (1 - gamma) * constant / step])
    wg, gg = signatures.onset_scan(ways, beta, np.stack([np.ones_like(step), gamma]), mean)
    interval_mean, sample_value = signatures.adjoint(ways)
    end_min = float(run.time_min[-1])
    for row in (0, 100, 400):
        onset_min = float(run.time_min[row + 1])
        for profile, shape, a, b in (
            (Step(run.time_min), [onset_min + 1e-9], wg[0], gg[0]),
            (Ramp(run.time_min), [onset_min], wg[1], gg[1]),
            (Decay(run.time_min), [onset_min, constant], wg[2], gg[2]),
        ):
            size = end_min - onset_min if isinstance(profile, Ramp) else 1.0  # the sums are those of a slope of 1
            felt, seen = profile.basis_signals(np.array(shape))[:2]
            g = size * signatures.forward_signatures(ways, 0, felt[1:-1], seen[2:])[:, :, 0]
            assert a[row, 0] == pytest.approx(np.sum(ways.w * g), rel=1e-5, abs=1e-6 * abs(np.sum(np.abs(ways.w * g))))
            assert b[row, 0] == pytest.approx(np.sum(g * g), rel=1e-5)
            of_w, of_g = signatures.gram(ways, 0, size * felt[1:-1], size * seen[2:])
            assert of_w[0] == pytest.approx(np.sum(ways.w * g), rel=1e-9, abs=1e-12 * np.sum(np.abs(ways.w * g)))
            assert of_g[0, 0] == pytest.approx(np.sum(g * g), rel=1e-12)
            adjoint = size * (interval_mean[:, 0] @ felt[1:-1, 0] + sample_value[:, 0] @ seen[2:, 0])
            assert adjoint == pytest.approx(np.sum(ways.w * g), rel=1e-6, abs=1e-9 * np.sum(np.abs(ways.w * g)))


@pytest.mark.parametrize("kind", [Constant, Step, Ramp, Decay, Sine, lambda times: PiecewiseLinear(times, 5)])
def test_the_signal_over_a_row_is_the_mean_of_what_is_at_every_moment(kind: type[FittedProfile], run: Run) -> None:
    profile = kind(run.time_min)
    parameters = np.concatenate(
        [np.linspace(0.5, 1.0, profile.n_linear), [17.77, 9.0][: len(profile.nonlinear_parameters)]]
    )
    fine = np.linspace(run.time_min[0], run.time_min[-1], 100 * (run.time_min.size - 1) + 1)
    same = kind(fine)
    evaluate_all = (
        np.interp(fine, profile.knots_min, parameters)
        if isinstance(profile, PiecewiseLinear)
        else same.signal(parameters).sample_value
    )
    means = (0.5 * (evaluate_all[1:] + evaluate_all[:-1])).reshape(-1, 100).mean(axis=1)
    interval_mean, sample_value = profile.signal(parameters)[:2]
    np.testing.assert_allclose(interval_mean[:-1], means, atol=6e-3)  # the step lies in one of a hundred pieces
    np.testing.assert_allclose(sample_value, evaluate_all[::100], atol=1e-9)


def test_a_break_after_a_row_hides_no_cause(run: Run) -> None:
    broken = replace(run, breaks=(300, 450))
    hypothesis = Hypothesis(FaultFilter(cstr(), (), NOISY), ())
    ways = Screen(cstr(), EFFECTS, broken).dynamics_of_all(hypothesis, hypothesis.evaluate(broken, ()), ())
    for item in (ways.F, ways.G, ways.H, ways.D, ways.K, ways.w):
        assert np.all(np.isfinite(item))
    assert not np.any(ways.G[298])  # from row 299 to row 300, where the filter begins anew


TIME_MIN: Array = np.arange(0.0, 100.0, 0.1)
LAG = effect_of("jacket_lag")


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [(Step, [1.5, 40.0]), (Ramp, [1.5, 25.0]), (Decay, [1.5, 30.0, DECAYS[1] * TIME_MIN[-1]])],
    ids=["step", "ramp", "decay"],
)
def test_of_all_courses_the_one_that_is_there_promises_most(kind: type[FittedProfile], parameters: list[float]) -> None:
    random = np.random.default_rng(1)
    g = random.standard_normal((TIME_MIN.size, 2))
    profile = kind(TIME_MIN)
    left = 0.1 * random.standard_normal(g.shape)
    w = g * profile.signal(np.array(parameters)).sample_value[:, None] + left
    run = Run(TIME_MIN, np.zeros((TIME_MIN.size, 1)), np.zeros_like(w))
    found = DynamicEffectsScreen([LAG], run).scale_signature(LAG, w, g)
    best = max(found, key=lambda candidate: candidate.score(run.values))
    assert best.profile.name == profile.name
    assert best.parameters == pytest.approx(parameters, rel=0.03)
    # Twice the gain in log likelihood of a deviation that explains all but what is left.
    assert best.gain == pytest.approx(np.sum(w**2) - np.sum(left**2), rel=0.01)


FOLLOWING = Noise((0.002, 0.3), (0.001, 0.3))


def problem(seed: int, columns: int) -> tuple[Array, Array, Array]:
    """A matrix and a vector that little of it explains, and the coefficients that explain most."""
    random = np.random.default_rng(seed)
    g = random.standard_normal((400, columns)) @ (np.eye(columns) + 0.3 * random.standard_normal((columns, columns)))
    w = random.standard_normal(400) + g @ random.standard_normal(columns)
    return g, w, np.asarray(np.linalg.lstsq(g, w, rcond=None)[0], dtype=np.float64)


@pytest.mark.parametrize("seed", range(5))
def test_without_bounds_a_pair_gains_what_least_squares_gain(seed: int) -> None:
    g, w, parameters = problem(seed, 8)
    gain, found = solve_bounded(g.T @ g, g.T @ w, np.full(8, -np.inf), np.full(8, np.inf))
    assert gain == pytest.approx(w @ w - np.sum((w - g @ parameters) ** 2), rel=1e-6)
    assert np.sum((g @ (found - parameters)) ** 2) < 1e-6 * gain


@pytest.mark.parametrize("seed", range(20))
def test_within_bounds_a_pair_promises_no_more_than_is_possible(seed: int) -> None:
    g, w, _ = problem(seed, 8)
    lowest, highest = np.zeros(8), np.full(8, 0.7)
    gain, found = solve_bounded(g.T @ g, g.T @ w, lowest, highest)
    best = lsq_linear(g, w, (lowest, highest), method="bvls").x
    assert np.all((found >= lowest) & (found <= highest))
    assert gain == pytest.approx(w @ w - np.sum((w - g @ found) ** 2), rel=1e-6)
    assert gain <= (w @ w - np.sum((w - g @ best) ** 2)) * (1 + 1e-6)


def test_the_two_that_are_there_are_promised_first_though_neither_looks_best_alone() -> None:
    run = make_run("feed_temperature:constant:1.0", "volume:ramp:0.04@50min,end=149.9min", rows=1500)
    screen = Screen(cstr(), EFFECTS, run)
    hypothesis = Hypothesis(FaultFilter(cstr(), (), FOLLOWING), ())
    fit = hypothesis.evaluate(run, ())
    pairs = PairScreen(screen, run).candidates(screen.dynamics_of_all(hypothesis, fit, ()), (), count=3)
    causes = {part.effect.name for part in pairs[0]}
    assert causes == {"feed_temperature", "volume"}
    assert screen.candidates(hypothesis, fit)[0].effect.name not in causes


def test_beside_another_cause_a_valve_that_sticks_is_named() -> None:
    record = record_of("concentration_gain:step:-0.05@60min", "valve_stiction:constant:2.5", rows=1200)
    found = diagnose(record, cstr())
    assert found.verdict == NAMED
    assert {cause.cause for cause in found.causes} == {"valve_stiction", "concentration_gain"}
    stiction = next(cause for cause in found.causes if cause.cause == "valve_stiction")
    assert stiction.parameters["size"].value == pytest.approx(2.5, abs=0.3)  # the same for all sizes near by
