"""The temperature and level controllers: their laws, their stability, manual and automatic."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from plant_node.config import PlantConfig
from plant_node.core import Plant, Row
from plant_node.record import plant_from, simulate_record
from plant_node.scenario import FromFile, scenario_settings
from reactorwatch.errors import InputError
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.cstr_operation import OPERATION, LevelControl, TemperatureControl
from reactorwatch.runtime.config import section
from tests.unit.plant_node.reactor import QUIET, Reactor, column, coolant_for, resting, rows

GAIN = TemperatureControl().gain_l_min_K
PERIOD_MIN = 0.1
FLOWS = (85.0, 90.0, 95.0, 100.0, 103.41, 105.0, 108.0, 111.0)


def plant(control: TemperatureControl, **settings: Any) -> Plant:
    return plant_from(PlantConfig(temperature_control=control, **{"noise_sd": QUIET, **settings}))


def at(flow_l_min: float, gain_l_min_K: float = GAIN) -> TemperatureControl:
    """A controller that holds the operating point of a flow."""
    return TemperatureControl(float(resting(flow_l_min)[1]), gain_l_min_K, flow_l_min)


def radius(flow_l_min: float, gain_l_min_K: float) -> float:
    """The largest eigenvalue of one sampled period in closed loop, by differences of SciPy's solution."""
    rest, change = resting(flow_l_min), np.array([1e-5, 1e-2])
    jacobian = np.empty((2, 2))
    for index in range(2):
        ends = []
        for sign in (1, -1):
            state = rest.copy()
            state[index] += sign * change[index]
            flow = flow_l_min + gain_l_min_K * (state[1] - rest[1])
            ends.append(Reactor().after(state, flow, PERIOD_MIN)[:2])
        jacobian[:, index] = (ends[0] - ends[1]) / (2 * change[index])
    return float(np.max(np.abs(np.linalg.eigvals(jacobian))))


@pytest.mark.parametrize("flow_l_min", FLOWS)
def test_the_default_gain_is_stable_with_a_margin_of_four(flow_l_min: float) -> None:
    """Inside the unit circle from a quarter of the gain to four times it, and damped better than without control."""
    assert all(radius(flow_l_min, factor * GAIN) < 0.97 for factor in (0.25, 1.0, 4.0))
    assert radius(flow_l_min, GAIN) < radius(flow_l_min, 0.0)


@pytest.mark.parametrize("flow_l_min", [85.0, 111.0])
def test_the_plant_under_control_settles_as_fast_as_its_eigenvalues(flow_l_min: float) -> None:
    rest = resting(flow_l_min)
    running = plant(at(flow_l_min), start={"C": float(rest[0]), "T": float(rest[1]) + 0.2})
    error = np.abs(column(rows(running, 120), "T") - rest[1])
    bound = radius(flow_l_min, GAIN) ** np.arange(120)
    assert np.all(error < 0.2 * 5 * bound + 1e-5)
    assert error[0] == pytest.approx(0.2, abs=1e-9)


def test_beyond_the_gain_that_the_eigenvalues_allow_the_plant_swings() -> None:
    critical = brentq(lambda gain: radius(85.0, gain) - 1, 10, 30, xtol=1e-3)
    assert critical == pytest.approx(18.0, abs=0.1)  # l/min/K
    rest = resting(85.0)
    swing = {}
    for share in (0.9, 1.1):
        running = plant(at(85.0, share * critical), start={"C": float(rest[0]), "T": float(rest[1]) + 0.2})
        swing[share] = np.ptp(column(rows(running, 300), "T")[-20:])
    assert swing[0.9] < 1e-4
    assert swing[1.1] > 1.0


def test_it_steadies_the_reactor_where_it_is_unstable_by_itself() -> None:
    """At 113 l/min the operating point has lost its stability; noise and all, the controller stays there."""
    rest = resting(113.0)
    start = {"C": float(rest[0]), "T": float(rest[1])}
    controlled = column(rows(plant(at(113.0), start=start, noise_sd={}, seed=1), 2000), "T")
    assert np.max(np.abs(controlled - rest[1])) < 3.0
    alone = PlantConfig(scenario={"kind": "constant", "level_l_min": 113.0}, start={**start, "T": start["T"] - 1})
    assert simulate_record(alone, 2000).columns["T"][-1] < 400


def test_rows_are_those_of_scipy_s_solver_under_the_same_law() -> None:
    running = plant(TemperatureControl(440.0, 3.0, 101.0), start={"C": 0.11, "T": 436.0})
    found, state = rows(running, 60), np.array([0.11, 436.0, 100.0])
    for row in found:
        flow = 101.0 + 3.0 * (state[1] - 440.0)
        expected = {"qc": flow, "C": state[0], "T": state[1]}
        assert row.readings == pytest.approx(expected, rel=0, abs=2e-5)
        state = Reactor().after(state, flow, PERIOD_MIN)


def test_the_command_of_a_row_answers_the_temperature_measured_in_it() -> None:
    """Noise and the bias of a sensor included; what is published is the command, whatever leaks."""
    control = TemperatureControl(438.0, 4.0, 100.0)
    faults = ("temperature_bias:step:3@2min", "coolant_flow:step:-0.1@4min")
    found = rows(plant(control, noise_sd={}, faults=faults), 100)
    np.testing.assert_allclose(column(found, "qc"), 100.0 + 4.0 * (column(found, "T") - 438.0), rtol=1e-12)
    assert np.std(column(found, "qc")) > 1.0


def test_the_valve_limits_what_the_controller_asks_for() -> None:
    running = plant(TemperatureControl(gain_l_min_K=10.0), noise_sd={}, valve_limits_l_min=(101.0, 105.0))
    found = column(rows(running, 200), "qc")
    assert (found.min(), found.max()) == (101.0, 105.0)


@pytest.mark.parametrize("share", [0.0, -0.1])
@pytest.mark.parametrize("bias_K", [0.0, 2.0])
def test_it_starts_and_stays_at_rest_where_the_balances_and_the_law_meet(share: float, bias_K: float) -> None:
    control = TemperatureControl(440.0, 4.0, 101.0)
    faults = [f"{name}:constant:{size}" for name, size in (("coolant_flow", share), ("temperature_bias", bias_K))]
    expected = brentq(
        lambda T: coolant_for(T) / (1 + share) - 101.0 - 4.0 * (T + bias_K - 440.0), 430.0, 450.0, xtol=1e-10
    )
    found = rows(plant(control, faults=tuple(faults)), 50)
    np.testing.assert_allclose(column(found, "T"), expected + bias_K, rtol=0, atol=1e-5)


def test_a_reactor_that_is_out_is_lit_again() -> None:
    """With the coolant shut there is no extinguished state: it warms up, ignites, and comes to rest."""
    found = rows(plant(TemperatureControl(), start={"C": 0.96389, "T": 353.553}), 400)
    assert found[50].readings["qc"] == 0.0
    assert column(found, "T").max() > 500
    assert found[-1].readings["T"] == pytest.approx(438.54, abs=1e-2)


def test_the_set_point_goes_in_steps_from_the_row_at_which_each_begins() -> None:
    control = TemperatureControl(((0.0, 438.54), (0.3, 441.0), (20.0, 436.0)))
    found = rows(plant(control), 400)
    set_points = column(found, "T") - (column(found, "qc") - 103.41) / GAIN
    assert set_points == pytest.approx([438.54] * 3 + [441.0] * 197 + [436.0] * 200, abs=1e-9)
    expected = brentq(lambda T: coolant_for(T) - 103.41 - GAIN * (T - 436.0), 430.0, 445.0, xtol=1e-10)
    assert found[-1].readings["T"] == pytest.approx(expected, abs=1e-4)


SQUARE = {"kind": "square", "low": 95.0, "high": 109.0, "period_min": 4.0}


def test_the_scenario_is_not_used_unless_as_dither() -> None:
    without = [rows(plant(TemperatureControl(), scenario=kind), 100) for kind in (SQUARE, "constant")]
    assert without[0] == without[1]
    found = rows(plant(TemperatureControl(dither=True), scenario=SQUARE, noise_sd={}), 100)
    added = column(found, "qc") - 103.41 - GAIN * (column(found, "T") - 438.54)
    assert added == pytest.approx(np.where(np.arange(100) // 20 % 2, 7.0, -7.0), abs=1e-9)


def test_with_dither_it_starts_at_rest_at_the_first_level() -> None:
    found = rows(plant(TemperatureControl(dither=True), scenario=SQUARE), 20)
    np.testing.assert_allclose(column(found, "T"), found[0].readings["T"], rtol=0, atol=1e-5)


@pytest.mark.parametrize("scenario", ["random-steps", "sines", "square", "constant"])
def test_dither_of_every_scenario_has_no_mean(scenario: str) -> None:
    """Over 2000 min; within four standard errors of the mean of its holds or periods."""
    settings = scenario_settings(scenario, OPERATION.inputs["qc"])
    assert not isinstance(settings, FromFile)
    levels = np.array([settings.level(number / 10, 3) - settings.mean for number in range(20_000)])
    assert abs(levels.mean()) <= 4 * levels.std() / np.sqrt(2000)


def test_dither_from_a_record_is_about_the_mean_of_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "record.csv"
    path.write_text("time_min,qc\n0,95\n1,105\n2,106\n")
    found = rows(plant(TemperatureControl(dither=True), scenario=str(path)), 30)
    added = column(found, "qc") - 103.41 - GAIN * (column(found, "T") - 438.54)
    assert added == pytest.approx(np.repeat([-7.0, 3.0, 4.0], 10), abs=1e-9)


def test_a_coolant_flow_that_is_set_is_manual_and_a_set_point_is_automatic() -> None:
    running = plant(TemperatureControl())
    modes = [running.mode]
    before = rows(running, 5)
    running.set_input("qc", 100.0)
    modes.append(running.mode)
    manual = rows(running, 150)
    running.set_input("T", 437.0)
    modes.append(running.mode)
    after = rows(running, 150)
    assert modes == ["automatic", "manual", "automatic"]
    assert column(before, "qc") == pytest.approx(103.41, abs=0.01)
    assert set(column(manual, "qc")) == {100.0}
    assert manual[-1].readings["T"] == pytest.approx(441.2184, abs=1e-3)  # the published operating point
    np.testing.assert_allclose(column(after, "qc"), 103.41 + GAIN * (column(after, "T") - 437.0), rtol=1e-12)


@pytest.mark.parametrize(
    ("signal", "value", "why"),
    [
        ("C", 0.1, "unknown input 'C' (valid: qc, T)"),
        ("T", 45.0, "set point of T must be in [250, 700] K, got 45"),
        ("T", math.nan, "set point of T must be in [250, 700] K, got nan"),
    ],
)
def test_inputs_that_cannot_be_are_refused_and_change_nothing(signal: str, value: float, why: str) -> None:
    running, undisturbed = plant(TemperatureControl()), plant(TemperatureControl())
    with pytest.raises(InputError) as caught:
        running.set_input(signal, value)
    assert str(caught.value) == why
    assert rows(running, 10) == rows(undisturbed, 10)


def test_faults_come_and_go_under_control_without_a_jump() -> None:
    running, undisturbed = plant(TemperatureControl()), plant(TemperatureControl())
    rows(running, 10)
    running.inject(parse_fault("heat_transfer:step:-0.5"))
    warmer = rows(running, 100)
    running.clear("heat_transfer")
    back = rows(running, 200)
    steady = rows(undisturbed, 1)[0].readings["T"]
    assert warmer[0].readings["T"] == pytest.approx(steady, abs=1e-5)
    assert warmer[-1].readings["T"] > steady + 0.3
    assert back[0].readings["T"] == pytest.approx(warmer[-1].readings["T"], abs=0.05)
    assert back[-1].readings["T"] == pytest.approx(steady, abs=1e-4)


@pytest.mark.parametrize(
    ("table", "why"),
    [
        ({"gain_l_min_K": 0.0}, "gain_l_min_K must be above 0, got 0; for none leave the table out"),
        ({"gain_l_min_K": math.inf}, "gain_l_min_K must be above 0, got inf"),
        ({"base_flow_l_min": -1.0}, "base_flow_l_min must be at least 0, got -1"),
        ({"set_point_K": []}, "set_point_K must have steps at rising times in min, the first at 0, got none"),
        ({"set_point_K": [[1, 440]]}, "set_point_K must have steps at rising times in min, the first at 0, got 1"),
        ({"set_point_K": [[0, 440], [0, 441]]}, "set_point_K must have steps at rising times in min, the first at 0"),
        ({"set_point_K": [[0, 440], [math.nan, 441]]}, "set_point_K must have steps at rising times in min, the first"),
        ({"set_point_K": math.nan}, "set_point_K must be above 0 K, got nan"),
        ({"gain": 3.0}, "Object contains unknown field `gain`"),
    ],
)
def test_wrong_settings_are_named_in_one_line(table: dict[str, Any], why: str) -> None:
    with pytest.raises(InputError) as caught:
        section(PlantConfig, "plant", {"plant": {"temperature_control": table}}, {})
    assert str(caught.value).startswith(f"settings [plant]: {why}")
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("table", "why"),
    [
        ({"set_point_K": 45.0}, "set point of T must be in [250, 700] K, got 45"),
        ({"base_flow_l_min": 250.0}, "controller of 'qc': base must be in [0, 200] l/min, got 250"),
    ],
)
def test_settings_that_do_not_go_with_the_plant_are_refused(table: dict[str, Any], why: str) -> None:
    with pytest.raises(InputError) as caught:
        plant(TemperatureControl(**table), valve_limits_l_min=(0.0, 200.0))
    assert str(caught.value) == why


def test_a_model_that_does_not_measure_the_temperature_cannot_be_controlled() -> None:
    model = cstr()
    blind = replace(model, outputs=model.outputs[:1])
    with pytest.raises(InputError, match=r"^controller of 'qc' needs a model with the output 'T', cstr has \('C',\)$"):
        plant_from(PlantConfig(temperature_control=TemperatureControl()), blind)


def level_plant(gain_per_min: float | None = 2.0, **settings: Any) -> Plant:
    level = None if gain_per_min is None else LevelControl(gain_per_min)
    values = {"noise_sd": QUIET, "scenario": "constant", "level_control": level, **settings}
    return plant_from(PlantConfig(**values))


def rows_and_volumes(of: Plant, count: int) -> tuple[list[Row], list[float]]:
    """Rows, and the volume at each."""
    found, volumes = [], []
    for _ in range(count):
        volumes.append(of.state["V"])
        found.append(of.next_row())
    return found, volumes


def test_without_a_change_of_the_inflow_it_is_the_plant_of_constant_volume() -> None:
    held, constant = level_plant(scenario="random-steps"), level_plant(None, scenario="random-steps")
    found, volumes = rows_and_volumes(held, 300)
    assert set(volumes) == {100.0}
    for row in found:
        assert row.readings == pytest.approx(constant.next_row().readings, rel=0, abs=1e-7)


def test_its_signals_are_those_of_every_plant() -> None:
    assert set(level_plant().units) == {"qc", "C", "T"}
    assert set(level_plant().state) == {"C", "T", "V"}


def test_rows_with_a_fault_of_the_inflow_are_those_of_scipy_s_balances() -> None:
    """The balances of amount and heat in a volume that moves, which the model does not use in this form."""
    running = level_plant(faults=("feed_flow:step:0.2@1min",), scenario="random-steps")
    found, volumes = rows_and_volumes(running, 60)
    state = resting(found[0].readings["qc"])
    for row, volume in zip(found, volumes, strict=True):
        shown = [row.readings["C"], row.readings["T"], volume]
        np.testing.assert_allclose(shown, state, rtol=0, atol=2e-5)
        reactor = Reactor(q=120.0 if row.number >= 10 else 100.0, level_gain=2.0)
        state = reactor.after(state, row.readings["qc"], 0.1)


def test_the_level_follows_the_inflow_with_the_time_constant_and_the_offset_of_its_controller() -> None:
    """dV/dt = q m - Kc (V - 100): to 100 + q m / Kc as 1 - exp(-Kc t); and from there back when the fault is gone."""
    running = level_plant()
    _, before = rows_and_volumes(running, 10)
    running.inject(parse_fault("feed_flow:step:-0.1"))
    _, during = rows_and_volumes(running, 40)
    running.clear("feed_flow")
    _, after = rows_and_volumes(running, 40)
    since = np.arange(40) / 10
    np.testing.assert_allclose(before, 100.0, rtol=1e-12)
    np.testing.assert_allclose(during, 100.0 - 5.0 * (1 - np.exp(-2 * since)), rtol=0, atol=1e-5)
    gone = -5.0 * (1 - np.exp(-2 * 4.0))
    np.testing.assert_allclose(after, 100.0 + gone * np.exp(-2 * since), rtol=0, atol=1e-5)


def test_it_starts_at_the_level_that_a_fault_of_always_keeps() -> None:
    running = level_plant(faults=("feed_flow:constant:0.1",))
    found, volumes = rows_and_volumes(running, 30)
    np.testing.assert_allclose(volumes, 105.0, rtol=1e-9)
    temperatures = [row.readings["T"] for row in found]
    np.testing.assert_allclose(temperatures, temperatures[0], rtol=0, atol=1e-5)


def test_a_start_without_a_level_has_it_at_rest() -> None:
    running = level_plant(start={"C": 0.1, "T": 438.54})
    assert running.state == pytest.approx({"C": 0.1, "T": 438.54, "V": 100.0})
    assert level_plant(start={"C": 0.1, "T": 438.54, "V": 90.0}).state["V"] == 90.0


def test_both_controllers_work_together() -> None:
    running = level_plant(temperature_control=TemperatureControl(), faults=("feed_flow:step:0.1@1min",))
    found, volumes = rows_and_volumes(running, 400)
    assert found[5].readings["T"] == pytest.approx(438.54, abs=1e-3)
    assert volumes[-1] == pytest.approx(105.0, abs=1e-6)
    # Where it comes to rest: the balances do not change any more at the flow that is commanded.
    last = np.array([found[-1].readings["C"], found[-1].readings["T"], volumes[-1]])
    on = Reactor(q=110.0, level_gain=2.0).after(last, found[-1].readings["qc"], 0.5)
    np.testing.assert_allclose(on, last, rtol=0, atol=1e-4)


def test_a_model_without_a_volume_is_refused() -> None:
    model = cstr()
    without = replace(model, parameters=tuple(item for item in model.parameters if item.name != "V"))
    with pytest.raises(InputError, match=r"^settings \[plant\]: level_control: cstr has no parameter 'V'"):
        plant_from(PlantConfig(level_control=LevelControl()), without)
