"""The run length of the e-detector without a fault is at least the stated one, for every noise of its class."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import lfilter

from reactorwatch.spc.charts.base import Baseline
from reactorwatch.spc.charts.edetector import EDetector
from reactorwatch.spc.compiled_chart import CompiledChart
from reactorwatch.spc.prewhitening import learn
from tests.unit.spc.members import Array, Plants

Noise = Callable[[np.random.Generator, int], Array]
ARL0 = 100.0

NOISES: dict[str, Noise] = {  # of unit variance
    "normal": lambda rng, n: rng.standard_normal(n),
    "Laplace": lambda rng, n: rng.laplace(size=n) / np.sqrt(2.0),
    "Student, 3 degrees of freedom": lambda rng, n: rng.standard_t(3, n) / np.sqrt(3.0),
    "skewed up": lambda rng, n: rng.exponential(size=n) - 1.0,
    "skewed down": lambda rng, n: 1.0 - rng.exponential(size=n),
    "one in a hundred": lambda rng, n: np.where(rng.random(n) < 0.01, np.sqrt(99.0), -1.0 / np.sqrt(99.0)),
}


def simulated_lengths(charts: list[CompiledChart], draw: Callable[[int], Array], longest: int) -> Array:
    """Run length of each chart, cut at `longest`, shape (charts,)."""
    plants = Plants(charts)
    running, lengths = np.ones(len(charts), dtype=np.bool_), np.zeros(len(charts))
    for row in range(longest):
        lengths += running
        running &= ~plants.update(draw(row))
        if not running.any():
            break
    return lengths


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("allowance", [0.0, 0.25])
def test_no_noise_of_the_class_breaks_the_run_length(noise: str, allowance: float) -> None:
    """Also where the mean is off by the whole allowance. Lengths are cut, which makes their mean smaller."""
    rng = np.random.default_rng(1)
    charts: list[CompiledChart] = [EDetector(0.0, 1.0, ARL0, allowance)] * 1000
    lengths = simulated_lengths(charts, lambda _: NOISES[noise](rng, 1000) + allowance, 20 * int(ARL0))
    assert lengths.mean() > ARL0 + 4.0 * lengths.std() / np.sqrt(1000)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("phi", [0.0, 0.7])
def test_no_noise_breaks_it_after_a_training(noise: str, phi: float) -> None:
    """Mean, standard deviation and autoregression are learned from 600 rows, in 200 plants."""
    rng, plants, rows = np.random.default_rng(2), 200, 600 + 10 * int(ARL0)
    charts: list[CompiledChart] = []
    watched = []
    for _ in range(plants):
        z = np.asarray(lfilter([1.0], [1.0, -phi], NOISES[noise](rng, rows)))
        learned = learn(z[:600], 1e-9)
        e = z[600:] - learned.constant
        for lag, a in enumerate(learned.coefficients, start=1):
            e -= a * z[600 - lag : z.size - lag]
        watched.append(e / learned.sd)
        baseline = Baseline((learned,), e[:, None], (1.0,), ARL0, 0.01, {"edetector_allowance": 0.25})
        charts.append(EDetector.design(baseline))
    lengths = simulated_lengths(charts, lambda row: np.array([e[row] for e in watched]), 10 * int(ARL0))
    assert lengths.mean() > ARL0 + 4.0 * lengths.std() / np.sqrt(plants)


def sums(evidence: Callable[[Array, float], Array], bets: Array, x: Array) -> Array:
    """The e-detector as its paper defines it: for every row, the sum of the e-processes started at each row before it.

    Args:
        evidence: e-values of values for a bet.
        bets: bets, of equal weight.
        x: shape (rows,).
    """
    total = np.zeros(len(x))
    for bet in bets.tolist():
        e = evidence(x, bet)
        total += np.array([sum(np.prod(e[start : row + 1]) for start in range(row + 1)) for row in range(len(x))])
    return np.asarray(total / len(bets))


def test_the_recursion_is_the_sum_over_all_starts() -> None:
    x = np.random.default_rng(3).standard_normal(40) * 0.8 + 0.3

    def evidence(values: Array, bet: float) -> Array:
        y = np.sign(bet) * values - 0.25
        return np.asarray(0.1 + 0.9 * np.maximum(1.0 + abs(bet) * y, 0.0) ** 2 / (1.0 + 1.2 * bet**2))

    steps = 2.0 ** np.arange(-3, 3)
    expected = np.log1p(sums(evidence, np.concatenate([steps, -steps]), x))
    chart = EDetector(0.0, 1.0, 1e8, 0.25, 1.2)
    assert [abs(chart.update(v).statistic) for v in x.tolist()] == pytest.approx(expected.tolist())


def test_normal_noise_takes_hardly_longer_than_the_published_detector_for_it() -> None:
    """R's edetect 0.1.0, vignette on run lengths: one side, sub-Gaussian, ARL 100: 7.0 rows at 1 sigma, 2.9 at 2.

    Its class is smaller, so its e-values are larger. Two sides cost here log 2 more. The bound is a half of its delay
    and a row.
    """
    rng = np.random.default_rng(4)
    for shift, published in ((1.0, 7.0), (2.0, 2.9)):
        plants = Plants([EDetector(0.0, 1.0, ARL0, 0.0)] * 4000)
        early = np.zeros(4000, dtype=np.bool_)
        for _ in range(50):
            early |= plants.update(rng.standard_normal(4000))
        running, delays = ~early, np.zeros(4000)
        for _ in range(500):
            delays += running
            running &= ~plants.update(rng.standard_normal(4000) + shift)
        assert delays[~early].mean() < 1.5 * published + 1.0
