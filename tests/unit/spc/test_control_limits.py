"""Designs, against published ones."""

from collections.abc import Mapping

import numpy as np
import pytest

from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Design
from reactorwatch.spc.charts.catalogue import chart as chart_of
from reactorwatch.spc.charts.cusum import cusum_limit, cusum_run_length
from reactorwatch.spc.charts.ewma import ewma_limit, ewma_run_length
from reactorwatch.spc.charts.mewma import mewma_limit, mewma_run_length
from reactorwatch.spc.charts.shewhart import shewhart_limit
from reactorwatch.spc.charts.t2 import t2_limit
from tests.unit.spc import published


def design(chart: str, arl0: float, shift: float, dimension: int = 2) -> Design:
    return chart_of(chart).fastest(arl0, shift, dimension, (1,))


def number(parameters: Mapping[str, float | int | list[int]], name: str) -> float:
    value = parameters[name]
    assert not isinstance(value, list)
    return value


@pytest.mark.parametrize(("k", "h"), [(0.25, 8.01), (0.5, 4.77), (0.75, 3.34), (1.0, 2.52), (1.25, 1.99), (1.5, 1.61)])
def test_limits_of_the_cusum(k: float, h: float) -> None:
    """Hawkins (1993), in Montgomery's book: h for an in-control run length of 370; two decimals."""
    assert cusum_limit(370.0, k) == pytest.approx(h, abs=0.011)


@pytest.mark.parametrize("chart", [chart for chart in published.EWMA if chart != (0.25, 3.0)])
def test_limits_of_the_ewma(chart: tuple[float, float]) -> None:
    """Lucas & Saccucci (1990), table 3: L for 500."""
    assert ewma_limit(500.0, chart[0]) == pytest.approx(chart[1], abs=0.0011)


def test_limits_of_the_mewma() -> None:
    """Rigdon (1995), J. Stat. Comput. Simulation 52, table 1: p = 4, lambda 0.25, H = 16.38 for 500."""
    assert mewma_limit(500.0, 4, 0.25) == pytest.approx(16.38, abs=0.011)


@pytest.mark.parametrize(("dimension", "length", "limit"), published.flat(published.T2_LIMITS))
def test_limits_of_t2(dimension: int, length: float, limit: float) -> None:
    assert t2_limit(length, dimension) == pytest.approx(limit, abs=0.0011)


def test_limits_of_shewhart() -> None:
    """3 sigma with any of the published sets of rules gives the published run length; rule 4 alone bounds it."""
    for rules, lengths in published.RUN_RULES.items():
        assert shewhart_limit(lengths[0.0], rules) == pytest.approx(3.0, abs=0.0005)
    with pytest.raises(InputError, match="arl0 must be below 255 with rule 4, which depends on no limit, got 370"):
        shewhart_limit(370.0, (1, 4))


@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("arl0", [370.4, 500.0])
def test_the_fastest_cusum_has_half_the_shift_as_its_allowance(shift: float, arl0: float) -> None:
    """Moustakides (1986), Annals of Statistics 14."""
    found = design("cusum", arl0, shift)
    assert number(found.parameters, "k") == pytest.approx(0.5 * shift, rel=0.03)
    assert cusum_run_length(0.0, number(found.parameters, "k"), number(found.parameters, "h")) == pytest.approx(arl0)


# Prabhu & Runger (1997), table of optimal charts, p = 4, for 500: shift, lambda, H, run length at the shift.
FASTEST_MEWMA = [
    (0.5, 0.04, 13.37, 42.22),
    (1.0, 0.105, 15.26, 14.60),
    (1.5, 0.18, 16.03, 7.65),
    (2.0, 0.28, 16.49, 4.82),
    (3.0, 0.52, 16.84, 2.55),
]


@pytest.mark.parametrize(("shift", "weight", "limit", "length"), FASTEST_MEWMA)
def test_the_fastest_mewma(shift: float, weight: float, limit: float, length: float) -> None:
    """Lambda to their step of 0.02 or 10 %, H and the run length to 2 %."""
    found = design("mewma", 500.0, shift, dimension=4)
    assert number(found.parameters, "lambda") == pytest.approx(weight, rel=0.1)
    assert number(found.parameters, "limit") == pytest.approx(limit, rel=0.02)
    assert found.arl == pytest.approx(length, rel=0.02)


@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0])
def test_no_published_ewma_is_faster_than_the_fastest(shift: float) -> None:
    """None of Lucas & Saccucci's charts of 500, and by no more than their spacing slower than the best of them."""
    found = design("ewma", 500.0, shift)
    best = min(lengths[shift] for chart, lengths in published.EWMA.items() if chart != (0.25, 3.0))
    assert 0.97 * best < found.arl < 1.002 * best


@pytest.mark.parametrize("chart", ["cusum", "ewma", "mewma"])
def test_no_neighbour_of_the_fastest_chart_is_faster(chart: str) -> None:
    """A tenth more or less of its memory's parameter, at the same false alarms: slower."""
    found = design(chart, 300.0, 1.2)
    name = "k" if chart == "cusum" else "lambda"
    for factor in (0.9, 1.1):
        near = factor * number(found.parameters, name)
        lengths = {
            "cusum": lambda near=near: cusum_run_length(1.2, near, cusum_limit(300.0, near)),
            "ewma": lambda near=near: ewma_run_length(1.2, near, ewma_limit(300.0, near)),
            "mewma": lambda near=near: mewma_run_length(1.2, 2, near, mewma_limit(300.0, 2, near)),
        }
        assert lengths[chart]() > found.arl


@pytest.mark.parametrize("chart", ["shewhart", "cusum", "ewma", "mewma", "t2"])
def test_seldom_false_alarms_can_be_asked_for(chart: str) -> None:
    """Once in a million samples, 69 days at ten a minute; longer memory or wider limits, so later, than for 1,000."""
    seldom, often = design(chart, 1e6, 1.5), design(chart, 1e3, 1.5)
    assert np.isfinite(seldom.arl)
    assert seldom.arl > often.arl
