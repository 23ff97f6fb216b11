"""Run lengths, against published ones and against independent methods."""

from collections.abc import Callable
from functools import partial
from math import floor, log10
from typing import Any

import numpy as np
import pytest
from scipy import integrate, sparse, special, stats
from scipy.sparse import linalg as sparse_linalg

from reactorwatch.errors import InputError
from reactorwatch.spc.charts.cusum import cusum_run_length
from reactorwatch.spc.charts.ewma import Ewma, ewma_run_length
from reactorwatch.spc.charts.mewma import mewma_run_length
from reactorwatch.spc.charts.shewhart import Shewhart, shewhart_run_length
from reactorwatch.spc.charts.t2 import t2_run_length
from tests.unit.spc import published
from tests.unit.spc.members import Array, Plants
from tests.unit.spc.published import flat
from tests.unit.spc.tables import BEGIN, END, PAGE, table

UNIVARIATE, MULTIVARIATE = 0.005, 0.02


def to_three_digits(length: float) -> float:
    """0.5 %, and what a number of three digits leaves open."""
    return UNIVARIATE * length + 0.5 * 10.0 ** (floor(log10(length)) - 2)


TABLES: list[tuple[str, Callable[[Any, float], float], dict[Any, dict[float, float]], Callable[[float], float]]] = [
    # Exact: to the last digit that Champ & Woodall print.
    ("run rules", lambda rules, d: shewhart_run_length(d, rules=rules), published.RUN_RULES, lambda _: 0.00501),
    ("cusum", lambda chart, d: cusum_run_length(d, 0.5, *chart), published.CUSUM, lambda n: UNIVARIATE * n),
    ("high sum", lambda d, h: cusum_run_length(d, 0.5, h, one_sided=True), {0.0: published.HIGH_SUM}, lambda _: 0.006),
    ("ewma", lambda chart, d: ewma_run_length(d, *chart), published.EWMA, lambda n: UNIVARIATE * n),
    ("mewma", lambda chart, d: mewma_run_length(d, *chart), published.MEWMA, lambda n: MULTIVARIATE * n),
    ("t2", lambda chart, d: t2_run_length(d, *chart), published.T2, lambda _: 0.005),
    (
        "steady cusum",
        lambda chart, d: cusum_run_length(d, *chart, steady_state=True),
        {(0.5, 4.0): published.STEADY_CUSUM},
        to_three_digits,
    ),
    ("steady ewma", lambda c, d: ewma_run_length(d, *c, steady_state=True), published.STEADY_EWMA, to_three_digits),
    # By simulation, with one decimal.
    (
        "exact limits",
        lambda chart, d: ewma_run_length(d, *chart, exact_limits=True),
        {(0.03, 2.437): published.EXACT_LIMITS_EWMA},
        lambda _: 0.07,
    ),
]
PUBLISHED = [
    pytest.param(partial(computed, chart, d), length, tolerance(length), id=f"{name} {chart}, {d:g}")
    for name, computed, table_, tolerance in TABLES
    for chart, d, length in flat(table_)
]


@pytest.mark.parametrize(("computed", "length", "tolerance"), PUBLISHED)
def test_run_lengths_are_those_published(computed: Callable[[], float], length: float, tolerance: float) -> None:
    assert computed() == pytest.approx(length, abs=tolerance)


def test_the_table_of_the_page_is_the_one_computed() -> None:
    """If not: `python -m tests.unit.spc.tables` writes it anew."""
    assert PAGE.read_text().split(BEGIN)[1].split(END)[0] == table()


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


class Lattice:
    """States and transitions of a two-sided CUSUM: an independent solver for how the sides combine.

    Values are rounded to multiples of a step that divides k, so both sums stay on the lattice and every state that can
    be reached is known exactly. The limit lies midway between two points of it. Then the error is of the order of
    step^2, and a third of the step, for which the same limit is midway too, tells where both lead (Richardson).

    Args:
        k: allowance.
        points: of the lattice in (0, h): h = (points + 1/2) k / steps.
        steps: in k.
        start: where both sums start.
    """

    def __init__(self, k: float, points: int, steps: int, start: float = 0.0) -> None:
        self.step = k / steps
        self.limit = points
        first = (round(start / self.step),) * 2
        self.number = {first: 0}
        todo = [first]
        self.moves: list[tuple[int, int, int]] = []
        reach = range(-2 * self.limit - 2 * steps, 2 * self.limit + 2 * steps + 1)
        while todo:
            state = todo.pop()
            for move in reach:
                target = (max(0, state[0] + move - steps), max(0, state[1] - move - steps))
                if max(target) > self.limit:
                    continue
                if target not in self.number:
                    self.number[target] = len(self.number)
                    todo.append(target)
                self.moves.append((self.number[state], self.number[target], move))

    def transitions(self, shift: float) -> sparse.csc_array:
        """K for a shift."""
        source, target, move = np.array(self.moves).T
        share = special.ndtr((move + 0.5) * self.step - shift) - special.ndtr((move - 0.5) * self.step - shift)
        size = len(self.number)
        return sparse.csc_array((share, (source, target)), shape=(size, size))

    def zero_state(self, shift: float) -> float:
        """The run length from the start."""
        return float(self._lengths(shift)[0])

    def steady_state(self, shift: float) -> float:
        """The run length after long without a signal."""
        in_control = self.transitions(0.0)
        solver = sparse_linalg.splu((sparse.eye_array(in_control.shape[0]) - in_control).T.tocsc())
        share = np.ones(in_control.shape[0]) / in_control.shape[0]
        for _ in range(30):
            share = solver.solve(share)
            share /= share.sum()
        return float(share @ self._lengths(shift))

    def _lengths(self, shift: float) -> Array:
        K = self.transitions(shift)
        return np.asarray(sparse_linalg.spsolve((sparse.eye_array(K.shape[0]) - K).tocsc(), np.ones(K.shape[0])))


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
        (lambda: t2_run_length(0.0, 0, 10.0), r"dimension must be in \[1, 100\], got 0"),
        (lambda: t2_run_length(0.0, 2, -1.0), "limit must be a positive number, got -1.0"),
    ],
)
def test_what_has_no_run_length_is_refused(call: object, message: str) -> None:
    assert callable(call)
    with pytest.raises(InputError, match=message):
        call()
