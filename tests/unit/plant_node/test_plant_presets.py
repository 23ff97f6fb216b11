"""The named runs."""

from typing import Any

import numpy as np
import pytest
from msgspec.structs import asdict
from typer.main import get_command

from plant_node.config import PlantConfig, fit_settings
from plant_node.record import simulate_record
from reactorwatch.cli.main import app
from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.cstr_operation import ONSET_MIN, OPERATION
from reactorwatch.process.steady_state import steady_states
from reactorwatch.records.record import Record
from reactorwatch.runtime.config import BusConfig, section

PRESETS = OPERATION.presets
NAMES = [item.name for item in PRESETS]
FAULTY = [name for name in NAMES if name != "fault-free"]
ONSET = round(ONSET_MIN / 0.1)


def read(table: dict[str, Any], **flags: Any) -> PlantConfig:
    return section(PlantConfig, "plant", {"plant": table}, flags)


@pytest.fixture(scope="module")
def records() -> dict[str, Record]:
    return {name: simulate_record(read({"preset": name})) for name in NAMES}


def test_they_are_the_four_records_of_the_work_this_starts_from() -> None:
    assert NAMES == ["fault-free", "input-leakage", "heat-transfer", "reaction-rate"]
    causes = [
        [str(item.effect.name) for item in fit_settings(read({"preset": name}), find_process()).faults]
        for name in NAMES
    ]
    assert causes == [[], ["coolant_flow"], ["heat_transfer"], ["reaction_rate"]]
    assert all(item.meaning for item in PRESETS)


def test_they_differ_in_their_fault_alone() -> None:
    nominal = asdict(read({"preset": "fault-free"}))
    for name in FAULTY:
        settings = asdict(read({"preset": name}))
        assert {key for key in settings if settings[key] != nominal[key]} == {"faults"}


@pytest.mark.parametrize("name", FAULTY)
def test_until_the_fault_sets_in_the_rows_are_the_fault_free_ones(name: str, records: dict[str, Record]) -> None:
    found, nominal = records[name].columns, records["fault-free"].columns
    assert found["T"].size == 4000
    np.testing.assert_array_equal(found["qc"], nominal["qc"])
    for signal in ("C", "T"):
        np.testing.assert_array_equal(found[signal][: ONSET + 1], nominal[signal][: ONSET + 1])
        assert np.any(found[signal][ONSET + 1 :] != nominal[signal][ONSET + 1 :])


@pytest.mark.parametrize(("name", "warmer"), [("input-leakage", 1), ("heat-transfer", 1), ("reaction-rate", -1)])
def test_the_fault_moves_the_operating_point_by_more_than_a_thermometer_s_noise(
    name: str, warmer: int, records: dict[str, Record]
) -> None:
    """By what the steady states at the mean flow say, roughly: the plant is moved about and is not linear."""
    model = parse_fault(read({"preset": name}).faults[0]).extend(cstr())
    before, after = (steady_states(model, np.array([95.0]), time)[-1].outputs[1] for time in (0.0, 300.0))
    expected = after - before
    difference = records[name].columns["T"] - records["fault-free"].columns["T"]
    assert expected * warmer > 3 * 0.3
    assert np.mean(difference[ONSET + 50 :]) == pytest.approx(expected, rel=0.35)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("name", NAMES)
def test_the_plant_stays_on_its_operating_branch(name: str, seed: int) -> None:
    found = simulate_record(read({"preset": name}, seed=seed), 4000).columns["T"]
    assert found.min() > 425.0


def test_the_file_overrides_the_preset_and_a_flag_overrides_both() -> None:
    table = {"preset": "input-leakage", "duration_min": 60.0, "noise_sd": {"T": 0.1}}
    config = read(table, duration_min=30.0)
    assert (config.duration_min, config.noise_sd["T"]) == (30.0, 0.1)
    assert config.faults == ("coolant_flow:step:-0.1@220min",)
    assert read(table).duration_min == 60.0
    assert read(table, preset="heat-transfer").faults == ("heat_transfer:step:-0.5@220min",)
    assert read({"preset": "input-leakage"}, faults=["coolant_flow:step:-0.2@1min"]).faults == (
        "coolant_flow:step:-0.2@1min",
    )


def test_a_stated_default_overrides_the_preset_too() -> None:
    config = read({"preset": "input-leakage", "faults": [], "scenario": "random-steps"})
    assert (config.faults, config.scenario) == ((), PlantConfig().scenario)


@pytest.mark.parametrize(
    ("table", "why"),
    [
        (
            {"preset": "input-leak"},
            "unknown preset 'input-leak'; did you mean 'input-leakage'? "
            "(valid: fault-free, input-leakage, heat-transfer, reaction-rate)",
        ),
        ({"preset": 3}, "unknown preset '3' (valid: fault-free,"),
        ({"pre_set": "fault-free"}, "unknown key 'pre_set'; did you mean 'preset'?"),
    ],
)
def test_an_unknown_preset_is_refused_with_the_valid_ones(table: dict[str, Any], why: str) -> None:
    with pytest.raises(InputError) as caught:
        read(table)
    assert str(caught.value).startswith(f"settings [plant]: {why}")


def test_other_nodes_have_no_presets() -> None:
    with pytest.raises(
        InputError,
        match=r"^settings \[bus\]: unknown key 'preset' \(valid: endpoint, routers, congestion, cache_messages, "
        r"history_s, ca, certificate, key\)$",
    ):
        section(BusConfig, "bus", {"bus": {"preset": "fault-free"}}, {})


def test_the_command_names_them_all() -> None:
    option = next(item for item in get_command(app).commands["plant"].params if item.name == "preset")  # type: ignore[attr-defined]
    assert all(name in option.help for name in NAMES)
