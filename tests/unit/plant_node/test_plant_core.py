"""The simulated plant, row by row."""

from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.core import Plant
from plant_node.record import plant_from, simulate_record
from reactorwatch.errors import InputError
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record
from tests.tables import read_csv
from tests.unit.plant_node.reactor import QUIET, column, rows


def plant(model: ProcessModel | None = None, **settings: object) -> Plant:
    values: dict[str, object] = {"noise_sd": QUIET, "scenario": "constant", **settings}
    return plant_from(PlantConfig(**values), model)  # type: ignore[arg-type]


def test_times_are_decimal_minutes() -> None:
    record = simulate_record(PlantConfig(noise_sd=QUIET), 400)
    assert record.time_min.tolist() == [float(f"{number / 10}") for number in range(400)]


def test_faulty_record_is_a_free_run_of_the_extended_model_while_qc_stays_the_command() -> None:
    text = "coolant_flow:step:-0.05@12.34min"
    faulty, nominal = (simulate_record(PlantConfig(noise_sd=QUIET, faults=faults), 300) for faults in ((text,), ()))
    np.testing.assert_array_equal(faulty.columns["qc"], nominal.columns["qc"])
    model = parse_fault(text).extend(cstr())
    start = np.array([nominal.columns["C"][0], nominal.columns["T"][0]])
    run = Simulator(model).run(faulty.time_min, faulty.columns["qc"], start)
    np.testing.assert_allclose(faulty.columns["T"], run.outputs[:, 1], rtol=0, atol=1e-5)
    np.testing.assert_array_equal(faulty.columns["T"][:124], nominal.columns["T"][:124])
    assert np.all(faulty.columns["T"][124:] != nominal.columns["T"][124:])


def test_driven_by_a_measured_record_it_makes_that_record(daisy_csv: Path) -> None:
    config = PlantConfig(noise_sd=QUIET, scenario=str(daisy_csv), start={"C": 0.1, "T": 438.54})
    measured = read_csv(daisy_csv)
    found = simulate_record(config, measured.rows)
    np.testing.assert_array_equal(found.columns["qc"], measured.columns["qc"])
    for signal, rmse in (("C", 2.7e-4), ("T", 0.05)):
        error = found.columns[signal] - measured.columns[signal]
        assert np.sqrt(np.mean(error**2)) <= rmse


def test_a_given_record_drives_instead_of_the_scenario() -> None:
    driver = Record(np.array([0.0, 0.5]), {"qc": np.array([95.0, 105.0])}, "given")
    found = simulate_record(PlantConfig(noise_sd=QUIET), 10, driver=driver)
    assert found.columns["qc"].tolist() == [95.0] * 5 + [105.0] * 5


@pytest.mark.parametrize(
    ("start", "temperature"), [("operating", 438.5417), ("extinguished", 353.553), ({"C": 0.5, "T": 400.0}, 400.0)]
)
def test_run_starts_at_the_given_state(start: object, temperature: float) -> None:
    """The published steady states at 103.41 l/min; in them the plant stays."""
    scenario = {"kind": "constant", "level_l_min": 103.41}
    found = column(rows(plant(start=start, scenario=scenario), 100), "T")
    assert found[0] == pytest.approx(temperature, abs=5e-4)
    if isinstance(start, str):
        np.testing.assert_allclose(found, found[0], atol=1e-6)


def test_a_fault_from_the_start_is_there_at_the_start_and_one_at_zero_is_not_yet() -> None:
    """A wrong valve gain that always was there belongs to the steady state; a leak at 0 moves the plant from there."""
    always = column(rows(plant(faults=("coolant_flow:constant:-0.05",)), 50), "T")
    np.testing.assert_allclose(always, 445.0187, atol=1e-4)  # the operating point at 95 l/min
    leak = column(rows(plant(faults=("coolant_flow:step:-0.05@0min",)), 50), "T")
    assert leak[0] == pytest.approx(441.2184, abs=1e-4)
    assert leak[1] > leak[0] + 0.1


def test_input_can_be_set_and_stays() -> None:
    running = plant()
    before = rows(running, 5)
    running.set_input("qc", 95.0)
    after = rows(running, 100)
    assert set(column(before, "qc")) == {100.0}
    assert set(column(after, "qc")) == {95.0}
    assert after[0].readings["T"] == pytest.approx(before[-1].readings["T"], abs=1e-5)
    assert after[-1].readings["T"] == pytest.approx(445.0187, abs=1e-3)


@pytest.mark.parametrize(
    ("signal", "value", "why"),
    [
        ("T", 400.0, "unknown input 'T' (valid: qc)"),
        ("qc", 200.5, "qc must be in [20, 200] l/min, got 200.5"),
        ("qc", float("nan"), "qc must be in [20, 200] l/min, got nan"),
    ],
)
def test_input_out_of_the_valves_reach_is_refused(signal: str, value: float, why: str) -> None:
    running = plant(valve_limits_l_min=(20.0, 200.0))
    with pytest.raises(InputError) as caught:
        running.set_input(signal, value)
    assert str(caught.value) == why
    assert running.next_row().readings["qc"] == 100.0


def test_scenario_beyond_the_valve_is_cut_there() -> None:
    found = column(rows(plant(scenario="square", valve_limits_l_min=(0.0, 100.0)), 200), "qc")
    assert set(found) == {95.0, 100.0}


def test_a_fault_is_put_in_and_taken_away_under_way() -> None:
    """From the operating point at 100 l/min to that at 95 and back; each change is told in the row it acts from."""
    running = plant()
    quiet = rows(running, 20)
    settled = running.inject(parse_fault("coolant_flow:step:-0.05"))
    assert str(settled) == "coolant_flow:step:-0.05@2min"
    faulty = rows(running, 100)
    assert [str(item) for item in running.clear("coolant_flow")] == ["coolant_flow:step:-0.05@2min"]
    again = rows(running, 100)
    assert [len(row.changes) for row in quiet + faulty + again] == [0] * 20 + [1] + [0] * 99 + [1] + [0] * 99
    there, gone = faulty[0].changes[0], again[0].changes[0]
    assert (there.active, there.onset_min, gone.active, gone.onset_min) == (True, 2.0, False, 2.0)
    assert faulty[0].readings["T"] == pytest.approx(441.2184, abs=1e-4)
    assert faulty[-1].readings["T"] == pytest.approx(445.0187, abs=1e-2)
    assert again[0].readings["T"] == pytest.approx(faulty[-1].readings["T"], abs=0.1)
    assert again[-1].readings["T"] == pytest.approx(441.2184, abs=1e-2)
    assert set(column(faulty, "qc")) == {100.0}


def test_a_fault_injected_is_the_same_as_one_configured() -> None:
    configured = rows(plant(faults=("heat_transfer:ramp:-0.2@3.05min,end=9min",)), 150)
    running = plant()
    injected = rows(running, 10)
    running.inject(parse_fault("heat_transfer:ramp:-0.2@3.05min,end=9min"))
    injected += rows(running, 140)
    assert injected == configured


def test_no_fault_is_published_before_its_onset() -> None:
    found = rows(plant(faults=("coolant_flow:step:-0.05@1.02min", "heat_transfer:constant:0.01")), 20)
    told = {str(change.specification): row.time_min for row in found for change in row.changes}
    assert told == {"coolant_flow:step:-0.05@1.02min": 1.1, "heat_transfer:constant:0.01": 0.0}


def test_a_fault_cleared_before_its_onset_was_never_there() -> None:
    running = plant(faults=("coolant_flow:step:-0.05@1min",))
    running.clear("coolant_flow")
    assert all(not row.changes for row in rows(running, 20))


def test_a_ramp_ends_with_the_run() -> None:
    running = plant(duration_min=30.0)
    rows(running, 10)
    assert str(running.inject(parse_fault("heat_transfer:ramp:-0.2"))) == "heat_transfer:ramp:-0.2@1min,end=30min"
    with pytest.raises(InputError, match="must be given where the run has no end"):
        plant().inject(parse_fault("heat_transfer:ramp:-0.2"))


def test_a_past_onset_and_an_absent_fault_are_refused_and_change_nothing() -> None:
    running, undisturbed = plant(), plant()
    found, expected = rows(running, 10), rows(undisturbed, 10)
    with pytest.raises(InputError, match=r"onset must not lie before the plant's time, 1 min, got 0\.5 min"):
        running.inject(parse_fault("coolant_flow:step:-0.05@30s"))
    with pytest.raises(InputError, match=r"^no fault 'coolant_flow' is in the plant \(there is: none\)$"):
        running.clear("coolant_flow")
    assert found + rows(running, 10) == expected + rows(undisturbed, 10)


def test_faults_that_the_model_cannot_have_are_refused() -> None:
    model = cstr()
    only_concentration = replace(model, outputs=model.outputs[:1])
    with pytest.raises(InputError, match=r"^fault 'temperature_bias:step:2@0min': temperature_bias needs a model with"):
        plant(only_concentration, faults=("temperature_bias:step:2",), noise_sd={"C": 0.0})
    running = plant(only_concentration, noise_sd={"C": 0.0})
    with pytest.raises(InputError, match="temperature_bias needs a model with"):
        running.inject(parse_fault("temperature_bias:step:2"))
    assert running.next_row() == plant(only_concentration, noise_sd={"C": 0.0}).next_row()


def test_it_extinguishes_ignites_again_and_continues() -> None:
    running = plant()
    rows(running, 10)
    running.set_input("qc", 135.0)
    out = rows(running, 150)
    running.set_input("qc", 2.0)
    burning = rows(running, 250)
    running.set_input("qc", 100.0)
    back = rows(running, 200)
    assert out[-1].readings["T"] < 355
    assert burning[-1].readings["T"] > 540
    assert back[-1].readings["T"] == pytest.approx(441.2184, abs=1e-2)
    assert all(row.good for row in out + burning + back)


def explosive() -> ProcessModel:
    """Above 150 l/min dT/dt = T^2, which has no solution beyond 1/T minutes."""
    model = cstr()
    T, qc = model.states[1].symbol, model.inputs[0].symbol
    return replace(model, rhs=(ca.SX(0), ca.if_else(qc > 150, T**2, 0)))


def test_where_the_equations_end_the_state_is_held_and_marked_until_they_resume() -> None:
    running = plant(explosive(), start={"C": 0.1, "T": 400.0})
    good = rows(running, 3)
    running.set_input("qc", 160.0)
    bad = rows(running, 4)
    assert running.trouble is not None
    assert running.trouble.startswith("cstr cannot be integrated beyond 0.6")
    running.set_input("qc", 100.0)
    after = rows(running, 3)
    # The row in which the input is set is still measured before anything goes wrong.
    assert [row.good for row in good + bad + after] == [True] * 4 + [False] * 4 + [True] * 2
    assert set(column(good + bad + after, "T")) == {400.0}
    assert [row.number for row in good + bad + after] == list(range(10))
    assert running.trouble is None


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"valve_limits_l_min": (0.0, 600.0)}, "settings [plant]: limits of qc must be in [0, 500] l/min, got 0"),
        ({"start": {"C": 0.1, "X": 1.0}}, "start: cstr has no state 'X' (valid: C, T)"),
        ({"start": {"C": 0.1, "T": 45.0}}, "start: T must be in [250, 700] K, got 45"),
        ({"start": {"C": 0.1, "T": float("nan")}}, "start: T must be in [250, 700] K, got nan"),
        ({"scenario": "nowhere.csv"}, "nowhere.csv"),
    ],
)
def test_settings_that_do_not_go_with_the_model_are_refused(settings: dict[str, Any], why: str) -> None:
    with pytest.raises(InputError) as caught:
        plant(**settings)
    assert str(caught.value).startswith(why)


def test_a_record_needs_a_length() -> None:
    with pytest.raises(
        ValueError, match="rows must be at least 1, or the configuration must have a duration, got None"
    ):
        simulate_record(PlantConfig(speed=inf))
    assert simulate_record(PlantConfig(duration_min=2.0)).rows == 20
