"""Samples are judged in the units of their process, in whatever unit they come."""

import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.ingest.samples import SampleUnits
from monitor_node.replay.backtest import run
from monitor_node.watched_process import watch_process
from reactorwatch.contract.codec import encode
from reactorwatch.description.process import Process, Signal
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.records.record import Record
from recorder.tools.player import samples_of

from ..samples import leaking_run

DECLARED = {"qc": "l/h", "C": "mol/m^3", "T": "degC"}


@pytest.mark.parametrize(
    ("unit", "value", "expected"),
    [
        ("degC", 20.0, (293.15, "K")),
        ("", 20.0, (293.15, "K")),  # as declared
        ("K", 20.0, (20.0, "K")),
        ("kelvin", 20.0, (20.0, "kelvin")),
    ],
)
def test_a_sample_is_converted_to_the_unit_of_the_equations(
    unit: str, value: float, expected: tuple[float, str]
) -> None:
    units = SampleUnits({"T": "degC"}, {"T": "K"})
    assert units.convert("T", unit, value) == expected
    assert units.convert("T2", unit, value) == (value, unit)


@pytest.mark.parametrize("unit", ["bar", "of its own"])
def test_a_unit_that_is_unknown_or_of_another_quantity_is_refused_and_without_units_nothing_is_converted(
    unit: str,
) -> None:
    units = SampleUnits({"T": "degC"}, {})
    for _ in range(2):
        with pytest.raises(InputError, match=f"sample of T: unit must convert to 'degC', got '{unit}'"):
            units.convert("T", unit, 1.0)
    assert SampleUnits({}, {}).convert("T", unit, 1.0) == (1.0, unit)


@pytest.mark.parametrize("names_units", [True, False])
def test_a_plant_in_units_of_its_own_raises_the_alarms_of_one_in_those_of_the_equations(names_units: bool) -> None:
    """Alarms name the units of the equations."""
    time_min, columns = leaking_run(-0.1, 25.0, 40.0, 4)
    model = cstr()
    signals = [Signal(name, DECLARED[name], "input" if name == "qc" else "output") for name in columns]
    rig = Process("rig", tuple(signals), model)
    own = {"qc": columns["qc"] * 60.0, "C": columns["C"] * 1000.0, "T": columns["T"] - 273.15}
    config = MonitorConfig(training_min=20.0, isolation=False, reference="equations")
    found = []
    for values, units in ((columns, model.units), (own, DECLARED if names_units else {})):
        watched = watch_process(config, rig)
        record = Record(time_min, {name: np.asarray(item) for name, item in values.items()}, "run", units=units)
        result = run((encode(item) for item in samples_of(record, "cstr")), watched.config, 0, watched.model)
        found.append([(alarm.alarm, alarm.raised_ns) for alarm, _ in result.raised_alarms])
        assert all(" degC" not in alarm.text for alarm, _ in result.raised_alarms)
    assert found[0]
    assert found[0] == found[1]
