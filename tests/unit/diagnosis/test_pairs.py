"""Two causes that are there together are promised as two, whatever one alone would look like."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.signatures import solve_bounded
from reactorwatch.diagnosis.result import NAMED
from reactorwatch.diagnosis.search.pair_screen import PairScreen
from reactorwatch.diagnosis.search.screen import Screen
from reactorwatch.process.library.cstr import EFFECTS, cstr
from tests.unit.diagnosis.runs import make_run, record_of

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
    assert pairs[0].causes == {"feed_temperature", "volume"}
    assert screen.candidates(hypothesis, fit)[0].effect.name not in pairs[0].causes


def test_beside_another_cause_a_valve_that_sticks_is_named() -> None:
    record = record_of("concentration_gain:step:-0.05@60min", "valve_stiction:constant:2.5", rows=1200)
    found = diagnose(record, cstr())
    assert found.verdict == NAMED
    assert [cause.cause for cause in found.causes] == ["valve_stiction", "concentration_gain"]
    assert found.causes[0].parameters["size"].value == pytest.approx(2.5, abs=0.3)  # the same for all sizes near by
