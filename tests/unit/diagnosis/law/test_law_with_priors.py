"""A law is found with parameters that are known but to a standard deviation, and both are estimated together."""

from collections.abc import Mapping

import numpy as np
import pytest
from msgspec.structs import replace

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.result import UNKNOWN
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.cstr_operation import BOILING_FROM_K, BOILING_RATE, EXAMPLES
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record

ROWS, PERIOD_MIN, NOISE_SD = 500, 0.1, (0.002, 0.3)


def boiling_reactor() -> Record:
    """Record of the reactor whose contents boil, from the nominal parameters."""
    random, build = np.random.default_rng(3), EXAMPLES["unknown"].with_law
    assert build is not None
    time_min = PERIOD_MIN * np.arange(ROWS, dtype=np.float64)
    inputs = np.repeat(random.uniform(90.0, 111.0, (ROWS // 10, 1)), 10, axis=0)
    outputs = Simulator(build(cstr())).run(time_min, inputs, np.array([0.1, 438.54])).outputs
    C, T = (outputs + np.array(NOISE_SD) * random.standard_normal(outputs.shape)).T
    return Record(time_min, {"qc": inputs[:, 0], "C": C, "T": T}, "boiling")


@pytest.mark.parametrize(
    ("stated", "sds"),
    [
        pytest.param({"K3": 714.0}, {"K3": 14.0}, id="stated 2 % too high"),
        pytest.param({"q": 100.0}, {"q": 0.02}, id="a flow", marks=pytest.mark.slow),
        pytest.param({"Tf": 350.0, "Tcf": 350.0}, {"Tf": 0.02, "Tcf": 0.02}, id="temperatures", marks=pytest.mark.slow),
    ],
)
def test_the_law_and_the_uncertain_parameters_are_within_their_intervals(
    stated: Mapping[str, float], sds: Mapping[str, float]
) -> None:
    truth, model = cstr(), cstr().with_values(stated)
    result = diagnose(boiling_reactor(), model, uncertain=sds)
    assert result.verdict == UNKNOWN
    assert result.law is not None
    assert set(result.parameters) == set(sds)
    for name, item in result.parameters.items():
        assert item.nominal == stated[name]
        assert item.estimate.sd <= 1.001 * sds[name]
        assert abs(item.estimate.value - truth.parameter(name).value) < 4.0 * item.estimate.sd
    assert result.law.parameters["b"].value == pytest.approx(-BOILING_RATE, abs=4.0 * result.law.parameters["b"].sd)
    assert result.law.parameters["c"].value == pytest.approx(BOILING_FROM_K, abs=4.0 * result.law.parameters["c"].sd)
    assert result.law.parameters == {
        name: replace(item, value=result.law.extended.parameters[name]) for name, item in result.law.parameters.items()
    }
