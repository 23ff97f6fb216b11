"""The interval of a parameter with a rough likelihood covers what the record leaves open."""

import numpy as np
import pytest

from reactorwatch.diagnosis.estimates import WITHIN_ROW, refine
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Step
from reactorwatch.diagnosis.record_checks import make_run as of_record
from reactorwatch.diagnosis.result import Estimate
from reactorwatch.diagnosis.search.search import Search
from reactorwatch.process.library.cstr import EFFECTS, cstr
from tests.hidden_effect.catalogue import named
from tests.hidden_effect.draw import draw
from tests.hidden_effect.excitation import NAMED_CIRCUMSTANCES
from tests.unit.diagnosis.runs import make_run

PERIOD_MIN = 0.1


def step_of(cause: str, size: float, onset_min: float, begun_min: float) -> tuple[Estimate, Estimate, float]:
    """Onset and size of a step in a plant, fitted from another onset; and the onset's standard deviation by the fit."""
    run = make_run(f"{cause}:step:{size}@{onset_min}min", rows=600)
    search = Search(cstr(), EFFECTS, run, (1e-4, 1e-2))
    effect = next(item for item in EFFECTS if item.name == cause)
    hypothesis = Hypothesis(search.filter((effect,)), (Step(run.time_min),))
    fitted = search.fit(hypothesis, (np.array([size, begun_min]),))
    search.update_noise(fitted)
    fitted = search.refit(fitted)
    by_fit = np.sqrt(np.diag(hypothesis.covariance(run, fitted.fit)))
    best, (sds,) = refine(search, fitted, [by_fit])
    size_of, onset = best.fit.parameters[0].tolist()
    return (
        Estimate(onset, sds[1], "min"),
        Estimate(size_of, sds.get(0, float(by_fit[0])), effect.unit),
        float(by_fit[1]),
    )


@pytest.mark.parametrize("onset_min", [30.005, 30.05, 30.095])
def test_the_interval_of_a_sensor_s_onset_ends_at_neighbouring_rows(onset_min: float) -> None:
    """A time that is uniform in an interval has the interval's length over the root of 12 as its standard deviation."""
    onset, _, _ = step_of("temperature_bias", 4.0, onset_min, 30.3)
    assert onset.value == pytest.approx(30.05, abs=0.02)
    assert onset.sd == pytest.approx(PERIOD_MIN / np.sqrt(12.0), rel=0.2)


def test_the_interval_of_a_lag_s_onset_ends_at_moves_of_the_input() -> None:
    """The input moves every minute: within one nothing shows when the valve became slow."""
    onset, _, _ = step_of("valve_lag", 0.2, 30.35, 30.35)
    assert onset.value == pytest.approx(30.5, abs=0.15)
    assert onset.sd == pytest.approx(1.0 / np.sqrt(12.0), rel=0.25)


def test_a_lag_is_found_from_an_onset_that_is_far_off() -> None:
    """The start is a local optimum ten minutes away."""
    onset, _, _ = step_of("valve_lag", 0.2, 30.35, 20.35)
    assert onset.value == pytest.approx(30.5, abs=0.15)


def test_the_interval_of_a_sticking_valve_spans_the_sizes_with_the_same_response() -> None:
    """The interval of its size holds the truth, and is not without bounds."""
    onset, size, _ = step_of("valve_stiction", 3.0, 30.35, 30.35)
    assert abs(size.value - 3.0) < 2.0 * size.sd < 1.0
    assert abs(onset.value - 30.35) < 2.0 * onset.sd < 10.0


def test_an_onset_of_which_the_likelihood_has_two_humps_may_be_at_either() -> None:
    """Held to the likelihood on a fine grid: here half a minute apart, with a valley of 3.5 between them."""
    effect = next(item for item in named() if item.name == "wall_heat_capacity")
    hidden = draw(31_100_016, (effect,), NAMED_CIRCUMSTANCES["medium"])
    size, onset_min = hidden.courses[0].size, hidden.courses[0].onset_min
    run = of_record(hidden.record, cstr())
    search = Search(cstr(), EFFECTS, run, (1e-4, 1e-2))
    ekf = search.filter(tuple(item for item in EFFECTS if item.name == effect.name))
    hypothesis = Hypothesis(ekf, (Step(run.time_min),))
    fitted = search.fit(hypothesis, (np.array([size, onset_min + 0.4]),))
    search.update_noise(fitted)
    fitted = search.refit(fitted)
    best, (sds,) = refine(search, fitted, [np.sqrt(np.diag(hypothesis.covariance(run, fitted.fit)))])
    sd, (found, estimate, *constants) = sds[1], best.fit.parameters[0].tolist()
    grid = np.arange(estimate - 1.0, estimate + 1.0, 0.02)
    losses = np.array([hypothesis.evaluate(run, (np.array([found, onset, *constants]),)).loss for onset in grid])
    likelihood = np.exp(losses.min() - losses)
    spread = np.sqrt(np.sum(likelihood * (grid - estimate) ** 2) / np.sum(likelihood))
    assert sd == pytest.approx(spread, rel=0.15)
    assert abs(estimate - onset_min) < 2.0 * sd


def test_a_smooth_onset_is_left_to_the_fit() -> None:
    """A leak's onset shows in the mean of a row: an interval is by the curvature, but no finer than part of a row."""
    onset, _, by_fit = step_of("coolant_flow", -0.05, 30.35, 30.35)
    assert onset.sd == pytest.approx(max(by_fit, WITHIN_ROW * PERIOD_MIN), rel=0.35)
    assert onset.value == pytest.approx(30.35, abs=3.0 * by_fit)
