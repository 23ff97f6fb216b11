"""The level controller in the plant."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.core import Plant, Row
from plant_node.record import plant_from
from reactorwatch.errors import InputError
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.cstr_operation import LevelControl, TemperatureControl
from tests.unit.plant_node.reactor import Reactor, resting
from tests.unit.plant_node.rows import QUIET


def plant(gain_per_min: float | None = 2.0, **settings: Any) -> Plant:
    level = None if gain_per_min is None else LevelControl(gain_per_min)
    values = {"noise_sd": QUIET, "scenario": "constant", "level_control": level, **settings}
    return plant_from(PlantConfig(**values))


def rows(of: Plant, count: int) -> tuple[list[Row], list[float]]:
    """Rows, and the volume at each."""
    found, volumes = [], []
    for _ in range(count):
        volumes.append(of.state["V"])
        found.append(of.next_row())
    return found, volumes


def test_without_a_change_of_the_inflow_it_is_the_plant_of_constant_volume() -> None:
    held, constant = plant(scenario="random-steps"), plant(None, scenario="random-steps")
    found, volumes = rows(held, 300)
    assert set(volumes) == {100.0}
    for row in found:
        assert row.readings == pytest.approx(constant.next_row().readings, rel=0, abs=1e-7)


def test_its_signals_are_those_of_every_plant() -> None:
    assert set(plant().units) == {"qc", "C", "T"}
    assert set(plant().state) == {"C", "T", "V"}


def test_rows_with_a_fault_of_the_inflow_are_those_of_scipy_s_balances() -> None:
    """The balances of amount and heat in a volume that moves, which the model does not use in this form."""
    running = plant(faults=("feed_flow:step:0.2@1min",), scenario="random-steps")
    found, volumes = rows(running, 60)
    state = resting(found[0].readings["qc"])
    for row, volume in zip(found, volumes, strict=True):
        shown = [row.readings["C"], row.readings["T"], volume]
        np.testing.assert_allclose(shown, state, rtol=0, atol=2e-5)
        reactor = Reactor(q=120.0 if row.number >= 10 else 100.0, level_gain=2.0)
        state = reactor.after(state, row.readings["qc"], 0.1)


def test_the_level_follows_the_inflow_with_the_time_constant_and_the_offset_of_its_controller() -> None:
    """dV/dt = q m - Kc (V - 100): to 100 + q m / Kc as 1 - exp(-Kc t); and from there back when the fault is gone."""
    running = plant()
    _, before = rows(running, 10)
    running.inject(parse_fault("feed_flow:step:-0.1"))
    _, during = rows(running, 40)
    running.clear("feed_flow")
    _, after = rows(running, 40)
    since = np.arange(40) / 10
    np.testing.assert_allclose(before, 100.0, rtol=1e-12)
    np.testing.assert_allclose(during, 100.0 - 5.0 * (1 - np.exp(-2 * since)), rtol=0, atol=1e-5)
    gone = -5.0 * (1 - np.exp(-2 * 4.0))
    np.testing.assert_allclose(after, 100.0 + gone * np.exp(-2 * since), rtol=0, atol=1e-5)


def test_it_starts_at_the_level_that_a_fault_of_always_keeps() -> None:
    running = plant(faults=("feed_flow:constant:0.1",))
    found, volumes = rows(running, 30)
    np.testing.assert_allclose(volumes, 105.0, rtol=1e-9)
    temperatures = [row.readings["T"] for row in found]
    np.testing.assert_allclose(temperatures, temperatures[0], rtol=0, atol=1e-5)


def test_a_start_without_a_level_has_it_at_rest() -> None:
    running = plant(start={"C": 0.1, "T": 438.54})
    assert running.state == pytest.approx({"C": 0.1, "T": 438.54, "V": 100.0})
    assert plant(start={"C": 0.1, "T": 438.54, "V": 90.0}).state["V"] == 90.0


def test_a_faster_controller_comes_closer_to_the_constant_volume_in_proportion() -> None:
    fault = ("feed_flow:step:0.2@1min",)
    limit = plant(None, faults=fault)
    constant = [limit.next_row().readings["T"] for _ in range(100)]
    away = []
    for gain in (5.0, 50.0, 500.0):
        found, _ = rows(plant(gain, faults=fault), 100)
        away.append(max(abs(row.readings["T"] - T) for row, T in zip(found, constant, strict=True)))
    assert 0.05 < away[1] / away[0] < 0.2
    assert 0.05 < away[2] / away[1] < 0.2


def test_both_controllers_work_together() -> None:
    running = plant(temperature_control=TemperatureControl(), faults=("feed_flow:step:0.1@1min",))
    found, volumes = rows(running, 400)
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
