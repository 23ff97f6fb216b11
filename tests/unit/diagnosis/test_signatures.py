"""What the linear map promises is what filters that know the deviation keep, and its three passes agree."""

from dataclasses import replace

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import Sized
from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, Course, Decay, Free, Ramp, Sine, Step
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.screen import Screen
from reactorwatch.kalman.error_dynamics import ErrorDynamics
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr.effects import EFFECTS
from reactorwatch.process.library.cstr.model import cstr
from tests.unit.diagnosis.runs import run_of

NOISY = Noise((0.002, 0.3), (0.001, 0.3))
NAMES = ("coolant_flow", "reaction_rate", "temperature_bias", "concentration_gain")


def effect_of(name: str) -> Effect:
    return next(effect for effect in EFFECTS if effect.name == name)


@pytest.fixture(scope="module")
def run() -> Run:
    return run_of(rows=600)


def followed(name: str, run: Run, course: Course, theta: Array) -> tuple[Hypothesis, Fit]:
    hypothesis = Hypothesis(Sized(cstr(), (effect_of(name),), NOISY), (course,))
    return hypothesis, hypothesis.at(run, (theta,))


def ways_of(name: str, run: Run) -> ErrorDynamics:
    hypothesis, fit = followed(name, run, Constant(run.time_min), np.zeros(1))
    return hypothesis.sized.ways(run, hypothesis.signals(fit), fit.found)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("kind", "theta"),
    [(Constant, [1.0]), (Step, [1.0, 20.03]), (Ramp, [1.0, 15.0]), (Decay, [1.0, 10.0, 7.0]), (Sine, [0.6, 0.8, 9.0])],
)
def test_the_signature_is_what_a_small_deviation_does(
    name: str, kind: type[Course], theta: list[float], run: Run
) -> None:
    course, numbers = kind(run.time_min), np.array(theta)
    over_row, at_row = course.basis(numbers[course.coefficients :])
    g = signatures.shown(ways_of(name, run), 0, over_row[1:-1], at_row[2:]) @ numbers[: course.coefficients]
    scale = 0.02 / np.sqrt(np.sum(g**2))
    up, down = numbers.copy(), numbers.copy()
    up[: course.coefficients] *= scale
    down[: course.coefficients] *= -scale
    near = [followed(name, run, course, item)[1].w[2:] for item in (down, up)]
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
    set_in = signatures.onsets(ways, beta, np.stack([np.ones_like(step), gamma]), mean)
    over_row, at_row = signatures.sought(ways)
    end_min = float(run.time_min[-1])
    for row in (0, 100, 400):
        onset_min = float(run.time_min[row + 1])
        for course, shape, a, b in (
            (Step(run.time_min), [onset_min + 1e-9], set_in.step_a, set_in.step_b),
            (Ramp(run.time_min), [onset_min], set_in.other_a[0], set_in.other_b[0]),
            (Decay(run.time_min), [onset_min, constant], set_in.other_a[1], set_in.other_b[1]),
        ):
            size = end_min - onset_min if isinstance(course, Ramp) else 1.0  # the sums are those of a slope of 1
            felt, seen = course.basis(np.array(shape))
            g = size * signatures.shown(ways, 0, felt[1:-1], seen[2:])[:, :, 0]
            assert a[row, 0] == pytest.approx(np.sum(ways.w * g), rel=1e-5, abs=1e-6 * abs(np.sum(np.abs(ways.w * g))))
            assert b[row, 0] == pytest.approx(np.sum(g * g), rel=1e-5)
            of_w, of_g = signatures.products(ways, 0, size * felt[1:-1], size * seen[2:])
            assert of_w[0] == pytest.approx(np.sum(ways.w * g), rel=1e-9, abs=1e-12 * np.sum(np.abs(ways.w * g)))
            assert of_g[0, 0] == pytest.approx(np.sum(g * g), rel=1e-12)
            adjoint = size * (over_row[:, 0] @ felt[1:-1, 0] + at_row[:, 0] @ seen[2:, 0])
            assert adjoint == pytest.approx(np.sum(ways.w * g), rel=1e-6, abs=1e-9 * np.sum(np.abs(ways.w * g)))


@pytest.mark.parametrize("kind", [Constant, Step, Ramp, Decay, Sine, lambda times: Free(times, 5)])
def test_the_signal_over_a_row_is_the_mean_of_what_is_at_every_moment(kind: type[Course], run: Run) -> None:
    course = kind(run.time_min)
    theta = np.concatenate([np.linspace(0.5, 1.0, course.coefficients), [17.77, 9.0][: len(course.numbers)]])
    fine = np.linspace(run.time_min[0], run.time_min[-1], 100 * (run.time_min.size - 1) + 1)
    same = kind(fine)
    at_all = np.interp(fine, course.knots_min, theta) if isinstance(course, Free) else same.signal(theta).at_row
    means = (0.5 * (at_all[1:] + at_all[:-1])).reshape(-1, 100).mean(axis=1)
    over_row, at_row = course.signal(theta)
    np.testing.assert_allclose(over_row[:-1], means, atol=6e-3)  # the step lies in one of a hundred pieces
    np.testing.assert_allclose(at_row, at_all[::100], atol=1e-9)


def test_a_break_after_a_row_hides_no_cause(run: Run) -> None:
    broken = replace(run, breaks=(300, 450))
    hypothesis = Hypothesis(Sized(cstr(), (), NOISY), ())
    ways = Screen(cstr(), EFFECTS, broken).ways_of_all(hypothesis, hypothesis.at(broken, ()), ())
    for item in (ways.F, ways.G, ways.H, ways.D, ways.K, ways.w):
        assert np.all(np.isfinite(item))
    assert not np.any(ways.G[298])  # from row 299 to row 300, where the filter begins anew
