"""A process that is no reactor, with one output and a catalogue of its own: two cascaded tanks.

The simulation lacks the overflow of the upper tank, as that of the benchmark does; the records come from equations
written by hand (`rig`).
"""

import json

import numpy as np
import pytest

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.report.page import as_page
from reactorwatch.diagnosis.result import NAMED, NOMINAL, Diagnosis
from reactorwatch.process import effects_of
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.sentences.diagnosis import describe_verdict, diagnosis_text
from tests.unit.diagnosis.rig import NOISE_V, Rig, record_of


@pytest.fixture(scope="module")
def overflowing() -> Diagnosis:
    return diagnose(record_of(Rig(overflow_per_min=10.0), seed=2), tanks())


def test_a_rig_that_is_as_simulated_is_nominal() -> None:
    found = diagnose(record_of(Rig(), seed=1), tanks())
    assert (found.verdict, found.causes, found.practical) == (NOMINAL, (), False)
    assert found.gain.held_out["x2"].rmse_after == pytest.approx(NOISE_V, rel=0.15)


def test_the_overflow_that_the_simulation_lacks_is_named_and_gained(overflowing: Diagnosis) -> None:
    found = overflowing
    (cause,) = found.causes
    assert (found.verdict, cause.cause, found.location, found.practical) == (NAMED, "overflow", "upper_tank", True)
    size = cause.parameters["size"]
    assert abs(size.value - 10.0) < 4 * size.sd < 4.0
    gain = found.gain.held_out["x2"]
    assert gain.rmse_before > 5 * NOISE_V
    assert gain.rmse_after < 1.15 * NOISE_V
    extended = parse_extended_model(json.dumps(found.extended_model)).build()
    assert extended.parameter("overflow.size").value == pytest.approx(size.value)


def test_another_brim_and_another_share_that_is_caught_are_fitted() -> None:
    rig = Rig(overflow_per_min=10.0, brim=7.5, caught=0.15)
    found = diagnose(record_of(rig, seed=5), tanks())
    (cause,) = found.causes
    assert (found.verdict, cause.cause) == (NAMED, "overflow")
    for name, truth in (("size", 10.0), ("brim", 7.5), ("caught", 0.15)):
        said = cause.parameters[name]
        assert abs(said.value - truth) < 4 * said.sd < 0.4 * truth, name
    assert found.gain.held_out["x2"].rmse_after < 1.15 * NOISE_V
    extended = parse_extended_model(json.dumps(found.extended_model)).build()
    assert extended.parameter("overflow.brim").value == pytest.approx(cause.parameters["brim"].value)
    assert "brim 7.5" in diagnosis_text(found, effects_of(tanks()))


@pytest.mark.parametrize(
    ("rig", "name", "size"),
    [
        (Rig(pump=0.05, onset_min=22.0), "pump_gain", 0.05),
        (Rig(leak=0.1, onset_min=25.0), "upper_leak", 0.1),
        (Rig(clogging=0.05), "outlet_clogging", 0.05),
        (Rig(bias=-0.1, onset_min=25.0), "level_bias", -0.1),
    ],
)
def test_each_other_cause_is_named(rig: Rig, name: str, size: float) -> None:
    found = diagnose(record_of(rig, seed=3, rows=1000), tanks())
    (cause,) = found.causes
    assert (found.verdict, cause.cause) == (NAMED, name)
    said = cause.parameters["size"]
    assert abs(said.value - size) < 4 * said.sd < 0.2 * abs(size)
    if rig.onset_min:
        assert cause.parameters["onset"].value == pytest.approx(rig.onset_min, abs=0.5)
    gain = found.gain.held_out["x2"]
    assert gain.rmse_after < 1.15 * NOISE_V < gain.rmse_before


def test_its_report_describes_tanks(overflowing: Diagnosis) -> None:
    found = overflowing
    catalogue = effects_of(tanks())
    assert describe_verdict(found).startswith("The simulation is wrong: overflow of the upper tank, ")
    page = as_page(found, tanks(), catalogue, "tanks.csv", "extended.json", on_the_bus=False)
    assert "in the upper tank" in page
    assert "a share of it into the lower tank" in page
    assert '<mrow class="added">' in page
    assert "reactorwatch plant" not in page
    for foreign in ("concentration", "temperature", "coolant", "reactor "):
        assert foreign not in page


def test_the_equations_are_those_of_the_benchmark() -> None:
    """At levels far above the smoothed corner: dx1/dt = k4 u - k1 sqrt(x1), dx2/dt = k2 sqrt(x1) - k3 sqrt(x2)."""
    model = tanks().with_values({"k1": 2.0, "k2": 1.5, "k3": 3.0, "k4": 2.5})
    rates, shown = model.function()([9.0, 4.0], [3.0], model.values(), 0.0, 0.0)
    np.testing.assert_allclose(np.array(rates).ravel(), [2.5 * 3 - 2.0 * 3, 1.5 * 3 - 3.0 * 2], rtol=1e-5)
    assert float(shown) == 4.0
