"""The proposed experiment, run on the plant node, decides between the alternatives of one record."""

import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.result import NAMED
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record

LIMITS = {"qc": (95.0, 112.0), "T": (425.0, 455.0)}
NARROW = {"kind": "random-steps", "low": 102.41, "high": 104.41}


@pytest.mark.parametrize(
    ("cause", "size", "alternative", "seed"),
    [
        ("coolant_flow", -0.02, "feed_temperature", 2),
        ("feed_temperature", 1.5, "coolant_flow", 2),
        ("heat_loss", 0.01, "coolant_flow", 2),
        ("reaction_heat", -0.01, "heat_loss", 2),
    ],
)
def test_the_experiment_decides(cause: str, size: float, alternative: str, seed: int) -> None:
    config = PlantConfig(seed=seed, faults=(f"{cause}:step:{size}@60min",), scenario=NARROW)
    open_ = diagnose(simulate_record(config, 1500), cstr(), limits=LIMITS)
    listed = {item.cause for item in open_.causes} | {name for item in open_.alternatives for name, _ in item.causes}
    assert {cause, alternative} <= listed
    experiment = open_.experiment
    assert experiment is not None
    assert {cause, alternative} <= set(experiment.separates)
    assert experiment.probability >= 0.9
    assert experiment.expected_delta_bic >= 10.0

    times, levels = np.array(experiment.input).T
    driver = Record(times, {"qc": levels}, "experiment")
    rows = round(experiment.span_min / 0.1)
    config = PlantConfig(seed=100 + seed, faults=(f"{cause}:constant:{size}",))
    measured = simulate_record(config, rows, driver=driver)
    decided = diagnose(measured, cstr())
    assert decided.verdict == NAMED
    assert [item.cause for item in decided.causes] == [cause]
    said = decided.causes[0].parameters["size"]
    assert abs(said.value - size) < 4.0 * said.sd
    assert decided.alternatives == ()
    assert decided.experiment is None
    assert np.mean((measured.columns["T"] < 425.0) | (measured.columns["T"] > 455.0)) < 0.002


def test_where_no_experiment_is_possible_a_remark_states_it_and_nothing_is_proposed() -> None:
    config = PlantConfig(seed=2, faults=("coolant_flow:step:-0.02@60min",), scenario=NARROW)
    found = diagnose(simulate_record(config, 1200), cstr(), limits={"T": (440.0, 440.5)})
    assert found.alternatives
    assert found.experiment is None
    assert "leave qc no room to move" in " ".join(found.remarks)


def test_where_nothing_is_left_open_no_experiment_is_proposed() -> None:
    config = PlantConfig(seed=2, faults=("coolant_flow:step:-0.05@60min",))
    found = diagnose(simulate_record(config, 1200), cstr())
    assert (found.verdict, found.alternatives, found.experiment) == (NAMED, (), None)
    assert not [remark for remark in found.remarks if "xperiment" in remark]
