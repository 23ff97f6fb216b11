"""A free curve has as many knots as the record supports."""

import numpy as np
import pytest

from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import PiecewiseLinear
from reactorwatch.diagnosis.fitting.refinement import GRID, select_knots
from reactorwatch.diagnosis.search.search import FittedHypothesis, Search
from reactorwatch.process.library.cstr import EFFECTS, cstr
from tests.unit.diagnosis.runs import make_run

LAST_MIN = 149.9


def curve(search: Search, cause: str, knots: int) -> FittedHypothesis:
    effect = next(item for item in EFFECTS if item.name == cause)
    profile = PiecewiseLinear(search.run.time_min, knots)
    hypothesis = Hypothesis(search.filter((effect,)), (profile,))
    return search.fit(hypothesis, (np.full(knots, 0.1 * effect.typical),))


def search_of(shares: list[float]) -> Search:
    """Through knots at even distances from the first row to the last."""
    times = np.linspace(0.0, LAST_MIN, len(shares))
    fault = ",".join(f"{time:.6f}min={share}" for time, share in zip(times, shares, strict=True))
    return Search(cstr(), EFFECTS, make_run(f"coolant_flow:free:-0.06,{fault}", rows=1500), (1e-4, 1e-2))


@pytest.mark.parametrize("shares", [[0.1, 1.0, 0.2, 0.9], [0.0, 1.0, 0.1, 0.7, 0.2, 0.9, 0.1]])
@pytest.mark.parametrize("begun", [12, 23])
def test_it_has_the_knots_of_the_truth(shares: list[float], begun: int) -> None:
    search = search_of(shares)
    fitted = curve(search, "coolant_flow", begun)
    search.update_noise(fitted)
    fitted = search.refit(fitted)
    grid = PiecewiseLinear(search.run.time_min, GRID)
    profile, parameters = select_knots(grid, search.run, fitted.hypothesis, fitted.fit, 0)
    assert profile.n_linear == len(shares)
    np.testing.assert_allclose(parameters, -0.06 * np.array(shares), atol=0.003)


def test_no_knot_is_added_or_taken_away_at_a_loss() -> None:
    search = search_of([0.1, 1.0, 0.2, 0.9])
    fitted = curve(search, "coolant_flow", 12)
    search.update_noise(fitted)
    fitted = search.refit(fitted)
    with_selected_knots = search.with_selected_knots(fitted)
    assert with_selected_knots.bic < fitted.bic - 6.0 * np.log(search.run.values)  # of eight knots that are not needed
    assert search.with_selected_knots(with_selected_knots) is with_selected_knots
