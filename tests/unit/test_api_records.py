"""Records in Python: from files, data frames and arrays, with the process that later functions use."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import reactorwatch as rw
from reactorwatch.description.read import ProcessChoice
from reactorwatch.records.record import Record as MeasuredRecord
from reactorwatch.records.write import write_table
from recorder.tools.convert import import_csv

ROWS = 300
RIG = rw.Process(
    "rig",
    (
        rw.Signal("u", "V", role="input"),
        rw.Signal("y", "degC", role="output", column="TI-1", bounds=(0.0, 100.0)),
        rw.Signal("batch", role="label"),
    ),
)


def columns() -> dict[str, np.ndarray[Any, np.dtype[Any]]]:
    generator = np.random.default_rng(5)
    u = np.repeat(generator.normal(size=ROWS // 10), 10)
    y = 20.0 + np.convolve(u, 0.5 * 0.8 ** np.arange(30))[:ROWS] + 0.02 * generator.normal(size=ROWS)
    return {"time_s": 2.0 * np.arange(float(ROWS)), "u": u, "TI-1": y}


class Frame:
    """A data frame of another library, as it shows itself to Arrow."""

    def __init__(self, **values: object) -> None:
        self._table = pa.table(values)

    def __arrow_c_stream__(self, requested_schema: object = None) -> object:
        return self._table.__arrow_c_stream__(requested_schema)


@pytest.fixture
def from_arrays() -> rw.Record:
    values = columns()
    return rw.Record(time_min=values["time_s"] / 60, signals={"u": values["u"], "y": values["TI-1"]}, process=RIG)


def test_arrays_a_frame_and_a_file_give_the_same_record(from_arrays: rw.Record, tmp_path: Path) -> None:
    table = np.column_stack(list(columns().values()))
    np.savetxt(tmp_path / "rig.csv", table, delimiter=",", header="time_s,u,TI-1", comments="", fmt="%.17g")
    from_file = rw.read_record(tmp_path / "rig.csv", process=RIG)
    from_frame = rw.read_record(Frame(**columns()), process=RIG)
    for record in (from_file, from_frame):
        assert record.process is RIG
        assert record.time_min == pytest.approx(from_arrays.time_min)
        assert record.signals.keys() == {"u", "y"}
        for name, values in record.signals.items():
            assert values == pytest.approx(from_arrays.signals[name])
        assert dict(record.units) == {"u": "V", "y": "degC"} == dict(from_arrays.units)
    assert from_frame.name == "data frame"


def test_a_record_is_taken_with_its_process_by_all_functions(from_arrays: rw.Record) -> None:
    found = rw.identify(from_arrays, output="y", model="oe", order=1)
    assert found.fit is found.fit_percent
    assert found.fit.free_run > 75.0
    result = rw.backtest(from_arrays)
    assert result.reference in ("black-box", "arx")
    assert (result.signals.inputs, result.signals.outputs) == (["u"], ["y"])
    assert result.trained_until_min == pytest.approx(100 * 2 / 60)
    for function in (rw.simulate, rw.diagnose):
        with pytest.raises(rw.InputError, match="process 'rig': must have equations for this, got none"):
            function(from_arrays)


def test_a_recording_describes_the_process_of_its_record(from_arrays: rw.Record, tmp_path: Path) -> None:
    write_table(tmp_path / "rig.csv", from_arrays)
    (tmp_path / "rig.toml").write_text(
        'name = "rig"\n[[signals]]\nname = "u"\nrole = "input"\n[[signals]]\nname = "y"\nrole = "output"\n'
    )
    import_csv(tmp_path / "rig.csv", tmp_path / "rig.mcap", choice=ProcessChoice(str(tmp_path / "rig.toml")))
    record = rw.read_record(tmp_path / "rig.mcap")
    assert isinstance(record.process, rw.Process)
    assert (record.process.inputs, record.process.outputs) == (("u",), ("y",))
    assert rw.backtest(record).signals == rw.backtest(from_arrays).signals


def test_values_outside_the_bounds_of_a_signal_are_not_measured() -> None:
    record = rw.Record(time_min=[0.0, 1.0, 2.0], signals={"u": [1, 2, 3], "y": [20.0, 3000.0, 21.0]}, process=RIG)
    assert np.isnan(record.signals["y"]).tolist() == [False, True, False]


def test_units_are_converted_to_those_of_the_process() -> None:
    values = {"u": [1.0, 1.0], "x2": [5.0, 5.1]}
    record = rw.Record(time_min=[0, 1], signals=values, process="tanks", units={"u": "mV"})
    assert record.signals["u"].tolist() == [0.001, 0.001]


def test_a_simulation_has_the_fields_of_the_command_and_is_a_record_of_the_same_process() -> None:
    time_min = np.arange(0.0, 5.0, 0.1)
    given = {"u": 3.0 + 0 * time_min, "x2": 5.0 + 0 * time_min}
    simulated = rw.simulate(rw.Record(time_min=time_min, signals=given, process="tanks"))
    assert isinstance(simulated, rw.Record)
    assert simulated.process == "tanks"
    difference = simulated.signals["x2"] - 5.0
    assert simulated.rmse["x2"].value == pytest.approx(np.sqrt(np.mean(difference**2)))
    assert simulated.rmse["x2"].unit == "V"
    assert rw.simulate(simulated).rmse["x2"].value == pytest.approx(0.0, abs=1e-9)


def test_where_times_step_back_a_new_run_begins() -> None:
    record = rw.Record(time_min=[0, 1, 2, 0.5, 1.5], signals={"u": np.arange(5.0)})
    assert record.run_starts == (0, 3)
    assert [run.rows for run in record.split_runs()] == [3, 2]
    assert isinstance(record.split_runs()[0], rw.Record)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"time_min": [0, 1, 1], "signals": {"u": [1, 2, 3]}}, "a time of its own, got 1 min in rows 1 and 2"),
        ({"time_min": [0, 1], "signals": {"u": [1, 2, 3]}}, "'u' must have as many rows as time_min, 2, got 3"),
        ({"time_min": [0, float("nan")], "signals": {"u": [1, 2]}}, "finite number of minutes"),
        ({"time_min": [], "signals": {}}, "at least one"),
        ({"time_min": [0, 1], "signals": {"u": ["a", "b"]}}, "signal 'u' must be numbers"),
        ({"time_min": [[0, 1]], "signals": {}}, "an array of shape"),
        ({"time_min": [0], "signals": {"x2": [1]}, "process": "tanks", "units": {"x2": "kg"}}, "got 'kg'"),
    ],
)
def test_arrays_that_are_no_record_are_refused(arguments: dict[str, object], expected: str) -> None:
    with pytest.raises(rw.InputError, match=expected):
        rw.Record(**arguments)  # type: ignore[arg-type]


def test_a_frame_without_a_signal_is_refused_by_its_own_name() -> None:
    with pytest.raises(rw.InputError, match=r"^data frame.*expected a column 'TI-1'"):
        rw.read_record(Frame(time_s=[0.0, 1.0], u=[1.0, 2.0]), process=RIG)
    with pytest.raises(rw.InputError, match=r"data frame: expected .* columns of plain values"):
        rw.read_record(Frame(time_s=[0.0], u=[{"a": [1]}]), process=RIG)


def test_a_measured_record_without_a_process_is_one_of_the_reactor() -> None:
    record = MeasuredRecord(np.arange(300.0), {"u": np.zeros(300), "x2": np.zeros(300)}, "rig")
    for function in (rw.simulate, rw.diagnose):
        with pytest.raises(rw.InputError, match="rig: must have the signals of cstr, qc, C, T missing, got u, x2"):
            function(record)
