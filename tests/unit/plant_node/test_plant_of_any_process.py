"""The simulated plant of any process: of the catalogue, described in a file, without equations."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plant_node.config import PlantConfig, fit_settings
from plant_node.core import Plant
from plant_node.node import PlantNode
from plant_node.record import plant_from, simulate_record
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, encode_message
from reactorwatch.contract.messages_pb2 import InjectFault, SetInput
from reactorwatch.description.process import Process, Signal
from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError
from reactorwatch.process import MODELS
from reactorwatch.process.operation import Controller
from reactorwatch.process.simulate import Simulator
from reactorwatch.runtime.config import section
from tests.unit.plant_node.reactor import column, rows

NAMES = [make().name for make in MODELS]
RIG = """
name = "rig"
equations = "three_tanks"
[parameters]
a2 = {value = 0.62, sd = 0.01, unit = "1"}
[[signals]]
name = "Q1"
role = "input"
unit = "l/h"
bounds = [0, 360]
[[signals]]
name = "Q2"
role = "input"
unit = "cm3/s"
[[signals]]
name = "h1"
role = "output"
unit = "mm"
resolution = 0.5
[[signals]]
name = "h2"
role = "output"
unit = "cm"
[[signals]]
name = "h3"
role = "output"
unit = "cm"
"""


def quiet(process: str, **settings: Any) -> PlantConfig:
    model = find_process(process).require_model()
    return PlantConfig(process=process, noise_sd=dict.fromkeys(model.units, 0.0), **settings)


@pytest.fixture
def rig(tmp_path: Path) -> str:
    path = tmp_path / "rig.toml"
    path.write_text(RIG, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("open_loop", [True, False])
def test_rows_are_a_free_run_of_the_equations_with_the_published_inputs(name: str, open_loop: bool) -> None:
    model = find_process(name).require_model()
    plant = plant_from(quiet(name, open_loop=open_loop, seed=3))
    start = np.array(list(plant.state.values()))
    found = rows(plant, 120)
    inputs = np.column_stack([column(found, item) for item in model.input_names])
    outputs = np.column_stack([column(found, item) for item in model.output_names])
    run = Simulator(model).run(np.array([row.time_min for row in found]), inputs, start)
    np.testing.assert_allclose(outputs, run.outputs, rtol=1e-7, atol=1e-7)
    assert np.all(np.ptp(inputs, axis=0) > 0.0)


@pytest.mark.parametrize("name", NAMES)
def test_every_input_moves_by_a_programme_of_its_own_from_the_seed_alone(name: str) -> None:
    records = [simulate_record(PlantConfig(process=name, seed=seed, open_loop=True), 200) for seed in (1, 1, 2)]
    inputs = find_process(name).inputs
    for signal in inputs:
        np.testing.assert_array_equal(records[0].columns[signal], records[1].columns[signal])
        assert np.any(records[0].columns[signal] != records[2].columns[signal])
    moved = [np.diff(records[0].columns[signal]) for signal in inputs]
    assert all(not np.allclose(one, other) for i, one in enumerate(moved) for other in moved[:i])


@pytest.mark.parametrize("name", NAMES[1:])
@pytest.mark.parametrize("generic", [False, True])
def test_every_effect_of_the_process_is_a_fault_that_changes_its_outputs(name: str, generic: bool) -> None:
    """Its own, and those made from its equations; those of the reactor are tested with its controllers."""
    sound = simulate_record(quiet(name, open_loop=True, scenario="sines"), 100)
    process = find_process(name)
    effects = process.faults[len(process.effects) :] if generic else process.effects
    for effect in effects:
        fault = f"{effect.name}:step:{min(2 * effect.typical, effect.upper)!r}@1min"
        faulty = simulate_record(quiet(name, open_loop=True, scenario="sines", faults=(fault,)), 100)
        changed = [np.abs(faulty.columns[item] - sound.columns[item])[11:].max() for item in process.units]
        assert max(changed) > 1e-6, fault


def test_the_tanks_start_and_stay_at_the_set_points_of_their_controllers() -> None:
    found = rows(plant_from(quiet("three_tanks", scenario="constant")), 100)
    for level, set_point in (("h1", 40.0), ("h2", 20.0)):
        np.testing.assert_allclose(column(found, level), set_point, rtol=0, atol=1e-6)


def test_integral_action_makes_a_leak_visible_in_the_pump_and_not_in_the_level() -> None:
    found = rows(plant_from(quiet("three_tanks", scenario="constant", faults=("leak1:step:0.1@5min",))), 600)
    assert column(found, "h1")[-1] == pytest.approx(40.0, abs=1e-3)
    lost = 0.1 * 0.5 * np.sqrt(2 * 981.0 * 40.0)  # Torricelli
    assert column(found, "Q1")[-1] - column(found, "Q1")[0] == pytest.approx(lost, rel=1e-2)


def test_the_integral_part_rests_while_the_pump_is_at_its_limit() -> None:
    config = quiet("three_tanks", scenario="constant", limits={"Q1": (0.0, 60.0)})
    running = plant_from(config)
    running.set_input("h1", 60.0)
    filling = rows(running, 300)
    assert column(filling, "Q1").max() == 60.0
    running.set_input("h1", 40.0)
    draining = rows(running, 300)
    assert column(draining, "Q1").min() == 0.0
    assert column(draining, "h1")[-1] == pytest.approx(40.0, abs=0.05)
    assert column(draining, "h1").min() > 38.0


def test_an_input_and_a_set_point_are_set_by_signal_and_the_other_loop_stays_on_automatic() -> None:
    running = plant_from(quiet("three_tanks", scenario="constant"))
    rows(running, 5)
    running.set_input("Q1", 35.0)
    modes = [running.mode]
    manual = rows(running, 50)
    assert set(column(manual, "Q1")) == {35.0}
    assert len(set(column(manual, "Q2"))) > 10
    running.set_input("h1", 41.0)
    modes.append(running.mode)
    assert modes == ["manual", "automatic"]
    assert rows(running, 400)[-1].readings["h1"] == pytest.approx(41.0, abs=1e-2)


def test_in_open_loop_inputs_are_set_one_by_one() -> None:
    running = plant_from(quiet("three_tanks", open_loop=True))
    running.set_input("Q2", 30.0)
    found = rows(running, 60)
    assert set(column(found, "Q2")) == {30.0}
    assert len(set(column(found, "Q1"))) > 1
    with pytest.raises(InputError, match=r"^unknown input 'h1' \(valid: Q1, Q2\)$"):
        running.set_input("h1", 30.0)


def test_commands_go_by_the_signals_and_the_effects_of_the_process() -> None:
    config = quiet("three_tanks", name="rig_1", scenario="constant")
    node = PlantNode(plant_from(config), config, lambda text: None)

    def command(name: str, message: Any) -> str:
        reply, _ = node.on_command(Encoded(keys.key("rig_1", keys.COMMAND, name), *encode_message(message)), 0)
        return f"{reply.accepted}: {reply.text}"

    assert command("set_input", SetInput(signal="Q2", value=30.0)) == "True: Q2 = 30 cm3/s from 0 min on, on manual"
    assert command("inject_fault", InjectFault(specification="leak2:step:0.1")).startswith("True: fault leak2")
    refusal = command("inject_fault", InjectFault(specification="coolant_flow:step:0.1"))
    assert refusal.startswith("False: fault 'coolant_flow:step:0.1': unknown cause 'coolant_flow'")


def test_a_described_rig_is_simulated_in_its_units_with_its_parameters(rig: str) -> None:
    own = plant_from(PlantConfig(process=rig, open_loop=True, scenario="constant", seed=2, noise_sd={"h1": 0.0}))
    assert own.units == {"Q1": "l/h", "Q2": "cm3/s", "h1": "mm", "h2": "cm", "h3": "cm"}
    row = own.next_row()
    nominal = plant_from(quiet("three_tanks", open_loop=True, scenario="constant")).next_row()
    assert row.readings["Q1"] == pytest.approx(3.6 * nominal.readings["Q1"])
    assert row.readings["h1"] % 0.5 == pytest.approx(0.0, abs=1e-9)
    # more flows out through the larger opening: the second tank rests lower
    assert row.readings["h2"] < nominal.readings["h2"] - 0.5
    own.set_input("Q1", 108.0)
    assert own.next_row().readings["Q1"] == pytest.approx(108.0)
    with pytest.raises(InputError, match=r"^Q1 must be in \[0, 360\] l/h, got 361$"):
        own.set_input("Q1", 361.0)


def test_a_controller_of_the_settings_takes_the_place_of_one_of_the_process() -> None:
    config = quiet("three_tanks", controllers={"Q1": {"set_point": [[0, 30.0], [1, 31.0]]}}, scenario="constant")
    found = rows(plant_from(config), 400)
    assert column(found, "h1")[0] == pytest.approx(30.0, abs=1e-5)
    assert column(found, "h1")[-1] == pytest.approx(31.0, abs=1e-3)
    assert column(found, "h2")[-1] == pytest.approx(20.0, abs=1e-3)


def test_a_process_in_python_brings_its_own_controllers() -> None:
    tanks = find_process("cascaded_tanks")
    control = Controller("u", "x2", 5.0, gain=-0.5, base=2.2, integral_time_min=1.0)
    own = Process("own", tanks.signals, tanks.equations, tanks.effects, (control,))
    plant = plant_from(PlantConfig(), own)
    assert rows(plant, 200)[-1].readings["x2"] == pytest.approx(5.0, abs=1e-4)


def test_what_the_process_decides_is_written_out_in_the_settings() -> None:
    process = find_process("three_tanks")
    config = PlantConfig(process="three_tanks", noise_sd={"h1": 0.2})
    complete = fit_settings(config, process).complete(config)
    assert complete.noise_sd == {"Q1": 0.0, "Q2": 0.0, "h1": 0.2, "h2": 0.05, "h3": 0.05}
    assert complete.limits == {"Q1": (0.0, 150.0), "Q2": (0.0, 150.0)}
    assert isinstance(plant_from(complete), Plant)


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"scenario": {"kind": "constant", "level": 30.0}}, "scenario must be a table for each input, like [plant."),
        ({"scenario": {"Q3": "constant"}}, "scenario: unknown input 'Q3' (valid: Q1, Q2)"),
        (
            {"scenario": {"Q1": {"kind": "constant", "level": 200.0}}},
            "scenario constant: level must be in [0, 150] cm3",
        ),
        ({"noise_sd": {"T": 0.1}}, "noise_sd: unknown signal 'T' (valid: Q1, Q2, h1, h2, h3)"),
        ({"limits": {"qc": (0.0, 1.0)}}, "limits: unknown input 'qc' (valid: Q1, Q2)"),
        ({"valve_limits_l_min": (0.0, 100.0)}, "valve_limits_l_min is for a process with one input, got Q1, Q2; give"),
        ({"controllers": {"h1": {}}}, "controllers: unknown input 'h1' (valid: Q1, Q2)"),
        ({"controllers": {"Q1": {"gain": 0.0}}}, "controllers: Q1: gain must be a number other than 0, got 0"),
        ({"open_loop": True, "controllers": {"Q1": {"gain": 1.0}}}, "controllers: Q1: Object missing required field"),
        ({"faults": ("coolant_flow:step:0.1",)}, "fault 'coolant_flow:step:0.1': unknown cause 'coolant_flow' (valid:"),
    ],
)
def test_settings_that_do_not_fit_the_process_are_named_in_one_line(settings: dict[str, Any], why: str) -> None:
    with pytest.raises(InputError) as caught:
        plant_from(PlantConfig(process="three_tanks", **settings))
    assert str(caught.value).startswith(f"settings [plant]: {why}")
    assert len(str(caught.value).splitlines()) == 1


def test_a_process_without_equations_is_refused_in_one_line_with_the_cure() -> None:
    bare = Process("bare", (Signal("u", "V", "input"), Signal("y", "V")))
    with pytest.raises(InputError) as caught:
        plant_from(PlantConfig(), bare)
    assert str(caught.value) == (
        "process 'bare': must have equations for this, got none; name those of the catalogue with "
        'equations = "NAME", or write them in a .py file'
    )


def test_the_older_name_of_the_process_is_taken_too() -> None:
    config = section(PlantConfig, "plant", {"plant": {"model": "three_tanks"}}, {})
    assert config.process == "three_tanks"
    assert section(PlantConfig, "plant", {"plant": {"model": "a.json"}}, {"process": "cstr"}).process == "cstr"
