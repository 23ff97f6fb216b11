"""Constants of an effect's own are fitted beside its size, with priors, and count in the evidence."""

from math import log

import numpy as np
import pytest

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.result import NAMED
from reactorwatch.process.library.cstr import SideReaction, WallHeatCapacity, cstr
from tests.unit.diagnosis.runs import record_of

NOISE = Noise((0.002, 0.3), (0.001, 0.1))


def fitted(fault: str) -> tuple[Hypothesis, float, np.ndarray]:
    """The side reaction's hypothesis, its cost for constants and its parameters, on a record with a fault."""
    run = make_run(record_of(*([fault] if fault else []), rows=900), cstr())
    hypothesis = Hypothesis(FaultFilter(cstr(), (SideReaction(),), NOISE), (Constant(run.time_min),))
    fit = hypothesis.fit(run, [np.array([0.1]) if not fault else np.array([0.3, 12000.0, 60.0])])
    return hypothesis, hypothesis.constants_evidence(run, fit), fit.parameters[0]


def test_constants_that_the_record_determines_are_found_and_charged_by_their_share_of_the_prior() -> None:
    hypothesis, cost, (size, E2, heat) = fitted("side_reaction:constant:0.4,E2=11000K,heat=30")
    assert hypothesis.n_parameters == 3
    assert (size, E2, heat) == pytest.approx((0.4, 11000.0, 30.0), rel=0.2)
    assert 4.0 < cost < 2 * log(4000 / 20) + 2 * log(100 / 0.5)


def test_constants_without_information_stay_at_their_nominal_values_and_cost_nothing() -> None:
    _, cost, (size, E2, heat) = fitted("")
    assert size < 0.02
    assert abs(E2 - 15000.0) < 4000.0
    assert abs(heat - 100.0) < 100.0
    assert cost < 1.0


@pytest.mark.parametrize(
    ("fault", "truth"),
    [
        ("side_reaction:constant:0.3,E2=9000K,heat=250", {"size": 0.3, "E2": 9000.0, "heat": 250.0}),
        ("side_reaction:constant:0.3,E2=19000K,heat=-40", {"size": 0.3, "E2": 19000.0, "heat": -40.0}),
        ("wall_heat_capacity:constant:0.4,exchange=0.7", {"size": 0.4, "exchange": 0.7}),
    ],
)
def test_an_effect_with_other_constants_is_named_with_them(fault: str, truth: dict[str, float]) -> None:
    found = diagnose(record_of(fault, rows=2500), cstr())
    (cause,) = found.causes
    assert (found.verdict, cause.cause) == (NAMED, fault.partition(":")[0])
    for name, value in truth.items():
        said = cause.parameters[name]
        assert abs(said.value - value) < 4 * said.sd, name
        assert said.sd < 0.25 * abs(value), name


def test_every_constant_is_within_its_bounds_and_has_a_prior() -> None:
    for effect in (SideReaction(), WallHeatCapacity()):
        for item in effect.constants:
            assert all(item.lower < value < item.upper for value in (item.value, *item.start_values))
            assert item.sd > 0.0
