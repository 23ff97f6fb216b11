"""Run lengths, against published ones and against independent methods."""

from math import floor, log10

import numpy as np
import pytest
from scipy import integrate, special, stats

from reactorwatch.errors import InputError
from reactorwatch.spc.charts.cusum import cusum_run_length
from reactorwatch.spc.charts.ewma import Ewma, ewma_run_length
from reactorwatch.spc.charts.mewma import mewma_run_length
from reactorwatch.spc.charts.shewhart import Shewhart, shewhart_run_length
from reactorwatch.spc.charts.t2 import t2_run_length
from tests.unit.spc import published
from tests.unit.spc.lattice import Lattice
from tests.unit.spc.members import Plants
from tests.unit.spc.published import flat

UNIVARIATE, MULTIVARIATE = 0.005, 0.02


@pytest.mark.parametrize(("rules", "shift", "length"), flat(published.RUN_RULES))
def test_run_rules(rules: tuple[int, ...], shift: float, length: float) -> None:
    """Exact: to the last digit that Champ & Woodall print."""
    assert shewhart_run_length(shift, rules=rules) == pytest.approx(length, abs=0.00501)


@pytest.mark.parametrize(("chart", "shift", "length"), flat(published.CUSUM))
def test_two_sided_cusum(chart: tuple[float, float], shift: float, length: float) -> None:
    h, head_start = chart
    assert cusum_run_length(shift, 0.5, h, head_start) == pytest.approx(length, rel=UNIVARIATE)


@pytest.mark.parametrize(("h", "length"), published.ONE_SIDED_CUSUM.items())
def test_one_sided_cusum(h: float, length: float) -> None:
    assert cusum_run_length(0.0, 0.5, h, one_sided=True) == pytest.approx(length, abs=0.006)


@pytest.mark.parametrize(("chart", "shift", "length"), flat(published.EWMA))
def test_ewma(chart: tuple[float, float], shift: float, length: float) -> None:
    assert ewma_run_length(shift, *chart) == pytest.approx(length, rel=UNIVARIATE)


@pytest.mark.parametrize(("chart", "shift", "length"), flat(published.MEWMA))
def test_mewma(chart: tuple[int, float, float], shift: float, length: float) -> None:
    assert mewma_run_length(shift, *chart) == pytest.approx(length, rel=MULTIVARIATE)


@pytest.mark.parametrize(("chart", "shift", "length"), flat(published.T2))
def test_t2(chart: tuple[int, float], shift: float, length: float) -> None:
    assert t2_run_length(shift, *chart) == pytest.approx(length, abs=0.005)


@pytest.mark.parametrize(("dimension", "length", "limit"), flat(published.T2_LIMITS))
def test_t2_limits(dimension: int, length: float, limit: float) -> None:
    """The limit of the table gives the run length that it stands for, to its digits."""
    assert t2_run_length(0.0, dimension, limit) == pytest.approx(length, rel=5e-4)


def to_three_digits(length: float) -> float:
    """0.5 %, and what a number of three digits leaves open."""
    return UNIVARIATE * length + 0.5 * 10.0 ** (floor(log10(length)) - 2)


@pytest.mark.parametrize(("shift", "length"), published.STEADY_CUSUM.items())
def test_steady_state_of_the_cusum(shift: float, length: float) -> None:
    computed = cusum_run_length(shift, 0.5, 4.0, steady_state=True)
    assert computed == pytest.approx(length, abs=to_three_digits(length))


@pytest.mark.parametrize(("chart", "shift", "length"), flat(published.STEADY_EWMA))
def test_steady_state_of_the_ewma(chart: tuple[float, float], shift: float, length: float) -> None:
    computed = ewma_run_length(shift, *chart, steady_state=True)
    assert computed == pytest.approx(length, abs=to_three_digits(length))


@pytest.mark.parametrize(("shift", "length"), published.EXACT_LIMITS_EWMA.items())
def test_ewma_with_exact_limits(shift: float, length: float) -> None:
    """Numbers by simulation, with one decimal."""
    assert ewma_run_length(shift, 0.03, 2.437, exact_limits=True) == pytest.approx(length, abs=0.07)


@pytest.mark.parametrize(
    ("weight", "limit", "shift", "printed"), [(0.03, 2.437, 0.5, 20.0), (0.05, 3.0, 1.0, 9.0), (0.05, 3.0, 2.0, 2.8)]
)
def test_the_published_start_of_the_ewma_is_off(weight: float, limit: float, shift: float, printed: float) -> None:
    """100,000 simulated runs meet the integral equation to 4 standard errors, the printed number not."""
    rng = np.random.default_rng(2)
    plants = 100_000
    charts = Plants([Ewma(0.0, 1.0, weight, limit, exact_limits=True)] * plants)
    running, lengths = np.ones(plants, dtype=np.bool_), np.zeros(plants)
    while running.any():
        lengths += running
        running &= ~charts.update(rng.standard_normal(plants) + shift)
    error = 4.0 * lengths.std() / np.sqrt(plants)
    assert abs(lengths.mean() - ewma_run_length(shift, weight, limit, exact_limits=True)) < error
    assert abs(lengths.mean() - printed) > error + 0.05


@pytest.mark.parametrize("start", [0.0, 1.5])
@pytest.mark.parametrize("shift", [0.0, 0.5, 2.0])
def test_the_sides_of_a_cusum_combine_as_the_chain_of_both(start: float, shift: float) -> None:
    """Zero state with and without head start, to 1e-5; steady state to 0.1 %."""
    k, h = 0.5, 24.5 / 6.0
    coarse, fine = Lattice(k, 24, 3, start), Lattice(k, 73, 9, start)
    zero = (9.0 * fine.zero_state(shift) - coarse.zero_state(shift)) / 8.0
    steady = (9.0 * fine.steady_state(shift) - coarse.steady_state(shift)) / 8.0
    assert cusum_run_length(shift, k, h, start) == pytest.approx(zero, rel=1e-5)
    assert cusum_run_length(shift, k, h, steady_state=True) == pytest.approx(steady, rel=1e-3)


def runger_prabhu(shift: float, dimension: int, weight: float, limit: float, cells: int) -> float:
    """The MEWMA by the chain of Runger & Prabhu (1996): cells along and across the shift, within the half disc."""
    radius = np.sqrt(limit * weight / (2.0 - weight))
    width = 2.0 * radius / (2 * cells + 1)
    along = width * np.arange(-cells, cells + 1)
    across = width * np.arange(cells + 1)
    edges = (along - 0.5 * width)[None, :], (along + 0.5 * width)[None, :]
    low, high = ((edge - (1.0 - weight) * along[:, None]) / weight - shift for edge in edges)
    P = stats.norm.cdf(high) - stats.norm.cdf(low)
    centre = ((1.0 - weight) * across / weight) ** 2
    bounds = (np.concatenate([[0.0], across + 0.5 * width]) / weight) ** 2
    freedom = dimension - 1
    cumulative = [stats.chi2.cdf(bounds, freedom) if c == 0 else stats.ncx2.cdf(bounds, freedom, c) for c in centre]
    Q = np.diff(np.array(cumulative), axis=1)
    inside = (along[:, None] ** 2 + across[None, :] ** 2 < radius**2).ravel()
    chain = np.kron(P, Q)[np.ix_(inside, inside)]
    lengths = np.linalg.solve(np.eye(len(chain)) - chain, np.ones(len(chain)))
    start = np.flatnonzero(np.flatnonzero(inside) == cells * (cells + 1))[0]
    return float(lengths[start])


@pytest.mark.parametrize(
    ("dimension", "weight", "limit", "shift"), [(2, 0.1, 8.64, 1.0), (4, 0.1, 12.73, 0.5), (3, 0.3, 12.0, 0.0)]
)
def test_mewma_is_the_limit_of_the_chain_of_runger_and_prabhu(
    dimension: int, weight: float, limit: float, shift: float
) -> None:
    """The chain of 25 cells is within 2 %."""
    chain = runger_prabhu(shift, dimension, weight, limit, 25)
    assert mewma_run_length(shift, dimension, weight, limit) == pytest.approx(chain, rel=MULTIVARIATE)


@pytest.mark.parametrize("dimension", [2, 3, 8, 15])
def test_a_vanishing_shift_of_the_mewma_is_none(dimension: int) -> None:
    """The equation with two dimensions meets the one with one."""
    limit = float(stats.chi2.isf(0.02, dimension))
    for steady_state in (False, True):
        without = mewma_run_length(0.0, dimension, 0.1, limit, steady_state=steady_state)
        with_shift = mewma_run_length(1e-9, dimension, 0.1, limit, steady_state=steady_state)
        assert with_shift == pytest.approx(without, rel=1e-5)


@pytest.mark.parametrize("dimension", [1, 2, 7, 20])
@pytest.mark.parametrize("weight", [1e-3, 1e-4])
def test_a_mewma_of_long_memory_is_an_ornstein_uhlenbeck_process(dimension: int, weight: float) -> None:
    """Its mean exit time from a ball, which Siegmund (1985) widens by 0.5826 steps for discrete time: to 0.1 %."""
    limit = float(stats.chi2.isf(1e-4, dimension))

    def integrand(r: float) -> float:
        inside = special.gammainc(0.5 * dimension, 0.5 * r * r) * special.gamma(0.5 * dimension)
        return float(inside * 2.0 ** (0.5 * dimension - 1.0) * r ** (1.0 - dimension) * np.exp(0.5 * r * r))

    radius = np.sqrt(limit) + 0.5826 * np.sqrt(weight * (2.0 - weight))
    exit_time = integrate.quad(integrand, 1e-12, radius, limit=400)[0] / -np.log1p(-weight)
    assert mewma_run_length(0.0, dimension, weight, limit) == pytest.approx(exit_time, rel=1e-3)


def test_charts_that_are_another_agree() -> None:
    """EWMA of lambda 1 and CUSUM of no height are Shewhart; MEWMA of one signal is EWMA, near lambda 1 it is T2."""
    for shift in (0.0, 1.0):
        single = shewhart_run_length(shift, 2.5)
        assert ewma_run_length(shift, 1.0, 2.5) == pytest.approx(single, rel=1e-9)
        assert t2_run_length(shift, 1, 2.5**2) == pytest.approx(single, rel=1e-9)
        assert cusum_run_length(shift, 2.5, 1e-3) == pytest.approx(shewhart_run_length(shift, 2.501), rel=1e-3)
        average = ewma_run_length(shift, 0.2, 2.5)
        assert mewma_run_length(shift, 1, 0.2, 2.5**2) == pytest.approx(average, rel=1e-9)
        near = mewma_run_length(shift, 3, 0.9999999, 12.0)
        assert near == pytest.approx(t2_run_length(shift, 3, 12.0), rel=1e-5)


def test_steady_state_forgets_the_start() -> None:
    """What has no memory has no steady state of its own; exact limits and a head start are gone in the long run."""
    assert shewhart_run_length(1.0, steady_state=True) == pytest.approx(shewhart_run_length(1.0))
    assert ewma_run_length(1.0, exact_limits=True, steady_state=True) == ewma_run_length(1.0, steady_state=True)
    assert cusum_run_length(1.0, 0.5, 4.0, 2.0, steady_state=True) == cusum_run_length(1.0, 0.5, 4.0, steady_state=True)


def test_steady_state_of_run_rules_by_simulation() -> None:
    """60 points without a signal first, then the shift: within 4 standard errors."""
    rng = np.random.default_rng(1)
    plants = 60_000
    charts = Plants([Shewhart(0.0, 1.0, rules=(1, 2, 3, 4))] * plants)
    quiet = np.ones(plants, dtype=np.bool_)
    for _ in range(60):
        quiet &= ~charts.update(rng.standard_normal(plants))
    lengths = np.zeros(plants)
    running = quiet.copy()
    while running.any():
        lengths += running
        running &= ~charts.update(rng.standard_normal(plants) + 1.0)
    error = lengths[quiet].std() / np.sqrt(quiet.sum())
    computed = shewhart_run_length(1.0, rules=(1, 2, 3, 4), steady_state=True)
    assert abs(lengths[quiet].mean() - computed) < 4 * error


def test_a_mirrored_shift_is_as_soon_seen() -> None:
    for signal in (cusum_run_length, ewma_run_length, shewhart_run_length):
        assert signal(-1.0) == signal(1.0)
    assert cusum_run_length(-1.0, one_sided=True) > cusum_run_length(1.0, one_sided=True)


def test_far_shifts_are_seen_at_once() -> None:
    """At 20 sigma: as many samples as the limit is away, without overflow on the side that is never reached."""
    assert cusum_run_length(20.0, 0.5, 5.0) == pytest.approx(1.0)
    assert ewma_run_length(20.0, 0.2, 3.0) == pytest.approx(1.0)
    assert shewhart_run_length(20.0, rules=(1, 2, 3, 4)) == pytest.approx(1.0)
    assert mewma_run_length(20.0, 3, 0.2, 12.0) == pytest.approx(1.0)
    assert t2_run_length(20.0, 3, 12.0) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: cusum_run_length(0.0, 0.5, 4.0, 3.0),
            "head_start must be at most h/2 \\+ k = 2.5 for two sides, got 3.0",
        ),
        (lambda: cusum_run_length(0.0, -0.5), "k must be a number of at least 0, got -0.5"),
        (lambda: ewma_run_length(0.0, 0.0), r"weight \(lambda\) must be in \(0, 1\], got 0.0"),
        (lambda: ewma_run_length(float("nan")), r"shift must be in \[-100, 100\] sigma, got nan"),
        (lambda: mewma_run_length(0.0, 0, 0.1, 8.0), r"dimension must be in \[1, 100\], got 0"),
        (lambda: mewma_run_length(1.0, 2, 1e-3, 8.0), r"weight \(lambda\) must be in \[0.01, 1\], got 0.001"),
        (lambda: mewma_run_length(0.0, 2, 1e-5, 8.0), r"weight \(lambda\) must be in \[0.0001, 1\], got 1e-05"),
        (lambda: shewhart_run_length(0.0, 30.0), r"the run length must be below 1e\+12 samples"),
        (lambda: t2_run_length(0.0, 2, -1.0), "limit must be a positive number, got -1.0"),
    ],
)
def test_what_has_no_run_length_is_refused(call: object, message: str) -> None:
    assert callable(call)
    with pytest.raises(InputError, match=message):
        call()
