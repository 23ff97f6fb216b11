"""Faults in the plant: its rows are the physics of them, also where a fault brings a state of its own."""

import json
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest
from msgspec.structs import replace as with_changes

from plant_node.config import PlantConfig
from plant_node.record import plant_from, simulate_record
from reactorwatch.errors import InputError
from reactorwatch.process.effect import Effect
from reactorwatch.process.fault import FaultSpecification, parse_fault
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.process.library.cstr_operation import LevelControl, TemperatureControl
from reactorwatch.process.model import ProcessModel, variable
from reactorwatch.process.profiles import CONSTANT
from reactorwatch.process.steady_state import complete_state, start_state
from tests.unit.plant_node.reactor import QUIET, Reactor


def test_a_flow_that_is_stamped_late_has_acted_when_its_row_is_measured() -> None:
    config = PlantConfig(noise_sd=QUIET, faults=("sample_timing:constant:0.04",), seed=3)
    record = simulate_record(config, 200)
    C, T, qc = (record.columns[name] for name in ("C", "T", "qc"))
    for row in np.flatnonzero(np.diff(qc)):
        x = np.array([C[row], T[row], 100.0])
        for span, flow in ((0.06, qc[row]), (0.04, qc[row + 1])):
            x = Reactor().after(x, flow, span)
        np.testing.assert_allclose([C[row + 1], T[row + 1]], x[:2], atol=1e-3, rtol=0)


def test_a_controller_does_not_see_how_its_commands_are_stamped() -> None:
    control = TemperatureControl(set_point_K=((0.0, 438.54), (2.0, 441.0)))
    late, in_time = (
        plant_from(PlantConfig(noise_sd=QUIET, temperature_control=control, faults=faults))
        for faults in (("sample_timing:constant:0.05", "temperature_bias:constant:1"), ("temperature_bias:constant:1",))
    )
    rows = [(late.next_row().readings, in_time.next_row().readings) for _ in range(60)]
    assert [a["qc"] for a, _ in rows] == [b["qc"] for _, b in rows]
    assert max(abs(a["T"] - b["T"]) for a, b in rows) > 0.1


def test_timing_is_wrong_of_whatever_else_is_wrong_in_whichever_order_it_was_put_in() -> None:
    faults = ("sample_timing:constant:0.05", "heat_loss:constant:0.01", "coolant_flow:constant:0.02")
    runs = [simulate_record(PlantConfig(noise_sd=QUIET, faults=order, seed=4), 50) for order in (faults, faults[::-1])]
    first, last = runs
    np.testing.assert_allclose(first.columns["T"], last.columns["T"], rtol=0, atol=1e-9)


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
@pytest.mark.parametrize("controlled", [False, True])
def test_every_effect_sets_in_on_a_plant_at_rest_and_moves_what_is_measured(effect: Effect, controlled: bool) -> None:
    """Under both controllers too; the flow is stepped after the onset, so that lags show."""
    control = TemperatureControl(set_point_K=((0.0, 438.54), (3.0, 437.0))) if controlled else None
    scenario = {"kind": "square", "low": 101.0, "high": 103.0, "period_min": 6.0}
    level = LevelControl() if controlled else None
    sound = PlantConfig(noise_sd=QUIET, temperature_control=control, level_control=level, scenario=scenario)
    fault = f"{effect.name}:step:{2 * effect.typical!r}@1min"
    runs = [simulate_record(config, 80).columns for config in (with_changes(sound, faults=(fault,)), sound)]
    off = np.abs(np.column_stack([runs[0][name] - runs[1][name] for name in ("C", "T")]))
    assert np.all(off[:10] < [1e-7, 1e-5])
    assert np.any(off[10:] > [1e-4, 1e-2])


def test_a_valve_that_begins_to_stick_stands_where_it_was() -> None:
    """It is made to stick before the flow is stepped by less than it sticks, and let go after."""
    plant, twin = (plant_from(PlantConfig(noise_sd=QUIET, scenario="constant")) for _ in range(2))
    shown, expected = [], []
    for number in range(60):
        if number == 10:
            plant.inject(parse_fault("valve_stiction:constant:3"))
            plant.set_input("qc", 102.0)
        if number == 30:
            plant.clear("valve_stiction")
            twin.set_input("qc", 102.0)
        shown.append(plant.next_row().readings)
        expected.append(twin.next_row().readings)
    assert [row["qc"] for row in shown[10:30]] == [102.0] * 20
    np.testing.assert_allclose([row["T"] for row in shown], [row["T"] for row in expected], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "text", ["sample_timing:constant:0.05", "valve_stiction:constant:2", "heat_loss:step:0.01@5min"]
)
def test_an_extended_model_is_the_plant_that_has_its_effects_as_faults(text: str, tmp_path: Path) -> None:
    path = tmp_path / "extended.json"
    path.write_text(json.dumps({"format": "reactorwatch.model.v1", "model": "cstr", "effects": [text]}))
    leak = "coolant_flow:step:-0.02@10min"
    of_model = simulate_record(PlantConfig(seed=3, process=str(path), faults=(leak,)), 300)
    of_faults = simulate_record(PlantConfig(seed=3, faults=(text, leak)), 300)
    for signal, values in of_model.columns.items():
        assert np.array_equal(values, of_faults.columns[signal])


class Thermowell(Effect):
    """The measured temperature follows T with a time constant of 1 min and a coefficient of size m."""

    name: ClassVar[str] = "thermowell"
    label: ClassVar[str] = "slow thermometer"
    location: ClassVar[str] = "temperature_sensor"
    unit: ClassVar[str] = "1"
    lower: ClassVar[float] = 0.0
    upper: ClassVar[float] = 1.0

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        well = variable("T_well", "K", (250.0, 700.0), 10.0, "temperature of the thermowell")
        T = model.states[model.state_names.index("T")].symbol
        return replace(
            model,
            states=(*model.states, well),
            rhs=(*model.rhs, T - well.symbol),
            outputs=tuple(
                replace(item, expression=(1 - size) * item.expression + size * well.symbol)
                if item.name == "T"
                else item
                for item in model.outputs
            ),
        )


QC = np.array([100.0])


def test_new_states_begin_at_rest_and_known_ones_go_over_by_name() -> None:
    model = Thermowell().extend(cstr())
    found = complete_state(model, {"T": 431.0, "C": 0.1, "gone": 7.0}, QC, 0.0)
    np.testing.assert_allclose(found, [0.1, 431.0, 431.0], rtol=1e-12)


def test_steady_states_are_distinguished_by_temperature_whatever_the_last_state_is() -> None:
    """Against the published three at 103.41 l/min."""
    model, qc = Thermowell().extend(cstr()), np.array([103.41])
    reversed_ = replace(model, states=model.states[::-1], rhs=model.rhs[::-1])
    assert start_state(reversed_, qc, "operating") == pytest.approx([438.5417, 438.5417, 0.1000129], abs=5e-5)
    assert start_state(model, qc, "extinguished") == pytest.approx([0.96389, 353.553, 353.553], abs=5e-4)


def test_a_fault_with_a_state_of_its_own_comes_and_goes_without_a_jump() -> None:
    config = PlantConfig(noise_sd={"C": 0, "T": 0}, start={"C": 0.2, "T": 430.0}, scenario="constant")
    running, undisturbed = (plant_from(config) for _ in range(2))
    slow = FaultSpecification(Thermowell(), CONSTANT, {"size": 1.0})
    true, measured = [], []
    for number in range(60):
        if number == 20:
            running.inject(slow)
        if number == 40:
            running.clear("thermowell")
        true.append(undisturbed.next_row().readings["T"])
        measured.append(running.next_row().readings["T"])
    np.testing.assert_allclose(measured[:21], true[:21], rtol=0, atol=1e-9)
    assert max(abs(a - b) for a, b in zip(measured[21:40], true[21:40], strict=True)) > 0.1
    np.testing.assert_allclose(measured[40:], true[40:], rtol=0, atol=1e-4)


def test_a_state_that_can_nowhere_rest_is_named() -> None:
    model = cstr()
    drifting = replace(model, rhs=(model.rhs[0], ca.exp(model.states[1].symbol / 1e3)))
    with pytest.raises(InputError, match=r"^cstr: T cannot be at rest while \{'C': 0\.1\}; give a start for them$"):
        complete_state(drifting, {"C": 0.1}, QC, 0.0)
