"""The report's flow chart: verdicts on records with known causes."""

import numpy as np
import pytest

from benchmarks.study_figures.flow_chart import follow
from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.identification.structure import Structure


def arx_record(rows: int = 6000, seed: int = 2) -> tuple[Array, Array]:
    """An ARX plant of order 1: every residual of its true model is white with standard deviation 0.1."""
    rng = np.random.default_rng(seed)
    u, y = np.repeat(rng.standard_normal(rows // 5), 5), np.zeros(rows)
    for k in range(1, rows):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + 1.0 + 0.1 * rng.standard_normal()
    return u, y


def test_an_undisturbed_record_is_fault_free() -> None:
    conclusion = follow(Structure.of_order(1), *arx_record())
    assert conclusion.verdict == "fault free"
    assert [branch.answer for branch in conclusion.branches] == ["yes", "no"]
    assert conclusion.lower_limit == pytest.approx(-0.3, rel=0.05)
    assert conclusion.upper_limit == pytest.approx(0.3, rel=0.05)


def test_false_faults_are_as_rare_as_promised() -> None:
    """One in a million is asked for: of 200 undisturbed records none is called a fault."""
    assert all(follow(Structure.of_order(1), *arx_record(600, seed)).verdict == "fault free" for seed in range(200))


def test_a_changed_plant_is_a_fault() -> None:
    u, y = arx_record()
    rng = np.random.default_rng(3)
    for k in range(4000, 6000):
        y[k] = 0.8 * y[k - 1] + 0.9 * u[k - 1] + 1.0 + 0.1 * rng.standard_normal()
    conclusion = follow(Structure.of_order(1), u, y, trusted_rows=4000)
    assert conclusion.verdict == "fault"
    assert [branch.answer for branch in conclusion.branches] == ["yes", "yes", "yes"]
    assert "-log10 p" in conclusion.branches[1].why


def test_a_plant_far_from_where_the_model_has_been_is_identified_again() -> None:
    """A hundred lively but tiny moves are trusted; the input then goes a thousand times as far: no fault is claimed."""
    rng = np.random.default_rng(4)
    u, y = np.repeat(rng.standard_normal(40), 5), np.zeros(200)
    u[:100] *= 0.1
    u[100:] *= 100.0
    for k in range(1, 200):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + 0.1 * rng.standard_normal()
    conclusion = follow(Structure.of_order(1), u, y, trusted_rows=100)
    assert conclusion.verdict == "identify again"
    assert conclusion.branches[-1].answer == "no"


def test_a_plant_sampled_too_fast_is_to_be_sampled_again() -> None:
    rng = np.random.default_rng(5)
    u, y = np.repeat(rng.standard_normal(20), 300), np.zeros(6000)
    for k in range(1, 6000):
        y[k] = 0.99 * y[k - 1] + 0.01 * u[k - 1]
    conclusion = follow(Structure.of_order(1), u, y + 1e-3 * rng.standard_normal(6000))
    assert conclusion.verdict == "sample again"
    assert "too fast" in conclusion.branches[0].why
    assert conclusion.model is None


def test_the_chart_refuses_what_it_cannot_begin_with() -> None:
    u, y = arx_record(600)
    with pytest.raises(InputError, match="trusted_rows must be between 1 and 599, got 600"):
        follow(Structure.of_order(1), u, y, trusted_rows=600)
    with pytest.raises(InputError, match="a constant input excites none"):
        follow(Structure.of_order(1), np.ones(600), y)
    with pytest.raises(InputError, match="none of the 300 rows after the trusted ones can be predicted"):
        follow(Structure.of_order(1), u, np.where(np.arange(600) < 300, y, np.nan))
