"""Impossible values are named before anything is fitted to them, and outliers are left out."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from reactorwatch.api.simulation import simulate_along
from reactorwatch.arrays import Array
from reactorwatch.cli.diagnose import DiagnosisOptions, load_case
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.fitting.outliers import find_gross_outliers, find_outliers, remove_outliers
from reactorwatch.diagnosis.record_checks import describe_short_record, make_run
from reactorwatch.diagnosis.run import Run
from reactorwatch.errors import InputError
from reactorwatch.process.effect import Effect
from reactorwatch.process.generic import generic_effects
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.model import ProcessModel, variable
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table
from tests.tables import read_csv
from tests.unit.diagnosis.linear_tank import RATE, Gain, Shift, tank, tank_record
from tests.unit.diagnosis.rig import Rig
from tests.unit.diagnosis.rig import record_of as rig_record
from tests.unit.diagnosis.runs import record_of

ROWS = 400
SENTINELS = (-999.0, -9999.0, -1.0, 9999.0, 65535.0, 1e30, -1e300)
MODELS = {"qc": cstr(), "C": cstr(), "T": cstr(), "u": tanks(), "x2": tanks()}
BOUNDS = {"qc": (0.0, 500.0), "C": (-0.1, 2.1), "T": (240.0, 710.0), "u": (0.0, 10.0), "x2": (-3.0, 53.0)}
"""Of the states one scale more to either side."""


@cache
def sound(signal: str) -> Record:
    """A record with that signal."""
    return record_of(rows=ROWS) if MODELS[signal].name == "cstr" else rig_record(Rig(), seed=1, rows=ROWS)


def spoiled(record: Record, signal: str, rows: list[int], value: float) -> Record:
    """The same with a value in some rows of a column."""
    values = record.columns[signal].copy()
    values[rows] = value
    return replace(record, columns=record.columns | {signal: values})


@settings(max_examples=40)
@given(
    signal=st.sampled_from(sorted(MODELS)),
    value=st.one_of(st.sampled_from(SENTINELS), st.floats(allow_nan=False, allow_infinity=False)),
    rows=st.sets(st.integers(0, ROWS - 1), min_size=1, max_size=ROWS // 2),
)
def test_any_value_outside_a_signals_bounds_is_named_in_any_rows(signal: str, value: float, rows: set[int]) -> None:
    lower, upper = BOUNDS[signal]
    assume(not lower <= value <= upper)
    record = spoiled(sound(signal), signal, sorted(rows), value)
    with pytest.raises(InputError) as reported:
        make_run(record, MODELS[signal])
    stated, place = str(reported.value), f"at {record.time_min[min(rows)]:g} min, column '{signal}'"
    assert f"{record.name}, {place}: must be in [{lower:g}, {upper:g}]" in stated
    assert f"got {value:g}" in stated
    assert stated.endswith("empty the cells that mean 'not measured'")
    assert (f"and {len(rows) - 1} more of it" in stated) == (len(rows) > 1)


@pytest.mark.parametrize("signal", ["qc", "C", "T"])
@pytest.mark.parametrize("rows", [[0], [123], list(range(5, ROWS, 50))])
def test_of_a_file_the_row_is_its_line(signal: str, rows: list[int], tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_table(path, spoiled(sound("qc"), signal, rows, -999.0))
    line = next(number for number, text in enumerate(path.read_text().split("\n"), start=1) if "-999" in text)
    with pytest.raises(InputError, match=rf"a\.csv, row {line} \(.*\), column '{signal}': .* got -999"):
        load_case(path, DiagnosisOptions())
    with pytest.raises(InputError, match=rf"row {line} \(.*\), column '{signal}': .* got -999"):
        simulate_along(read_csv(path), cstr(), [])


@pytest.mark.parametrize("signal", sorted(MODELS))
def test_values_at_the_bounds_are_no_sentinels(signal: str) -> None:
    record = spoiled(spoiled(sound(signal), signal, [7], BOUNDS[signal][0]), signal, [9], BOUNDS[signal][1])
    make_run(record, MODELS[signal])


def test_where_lines_are_no_rows_only_the_time_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_table(path, spoiled(sound("qc"), "T", [2], 9999.0))
    lines = path.read_text().split("\n")
    path.write_text("\n".join([*lines[:2], "", *lines[2:]]))
    with pytest.raises(InputError, match=r"a\.csv, at 0\.2 min, column 'T'"):
        load_case(path, DiagnosisOptions())


VALUES = 5000


def noise(seed: int = 1, sd: float = 0.3) -> Array:
    return np.random.default_rng(seed).standard_normal((VALUES, 2)) * sd


def spiked(values: Array, share: float, sds: float, sd: float = 0.3, seed: int = 2) -> tuple[Array, NDArray[np.bool_]]:
    random = np.random.default_rng(seed)
    off: NDArray[np.bool_] = random.random(values.shape) < share
    return values + off * random.choice([-1.0, 1.0], values.shape) * sds * sd, off


@pytest.mark.parametrize(("share", "sds", "caught"), [(0.01, 12.0, 0.95), (0.05, 12.0, 0.85), (0.001, 1e6, 0.99)])
def test_outliers_are_found_and_nothing_else_is(share: float, sds: float, caught: float) -> None:
    values, off = spiked(noise(), share, sds)
    found = find_outliers(values, values)
    assert np.mean(found[off]) > caught
    assert np.count_nonzero(found & ~off) <= 2  # of ten thousand


def test_a_gross_one_is_detected_without_a_model_in_the_first_row_too() -> None:
    moving = noise(sd=0.05) + 5.0 * np.abs(np.sin(0.3 * np.arange(VALUES)))[:, None]  # with a sharp turn in ten rows
    assert not np.any(find_gross_outliers(moving))
    for row in (0, 700, VALUES - 1):
        spoiled = moving.copy()
        spoiled[row, 1] += 300.0
        assert np.argwhere(find_gross_outliers(spoiled)).tolist() == [[row, 1]]


@pytest.mark.parametrize(
    "profile",
    [
        lambda k: 30.0 * (k > 2000),  # a jump
        lambda k: 3.0 * np.exp(-(k % 10) / 8.0),  # what a late input leaves after each of its steps
        lambda k: 3.0 * np.abs((k % 20) - 10.0) / 10.0,  # peaks
        lambda k: 5.0 * ((k > 1000) & (k < 1004)),  # four rows are no moment
    ],
)
def test_what_lasts_is_no_outlier(profile: object) -> None:
    assert callable(profile)
    residual = noise(sd=0.05) + np.asarray(profile(np.arange(float(VALUES))))[:, None]
    assert np.count_nonzero(find_outliers(residual, residual)) <= 1


def test_where_the_simulation_alone_has_a_peak_nothing_measured_is_an_outlier() -> None:
    measured = noise() + 40.0 * (1.0 + np.tanh(np.arange(VALUES) - 2500.0))[:, None]  # the reactor ignites
    residual = measured - 40.0 * np.exp(-np.abs(np.arange(VALUES) - 2490.0) / 0.5)[:, None]
    assert not np.any(find_outliers(measured, residual))


@pytest.mark.parametrize("step", [0.15, 0.6, 3.0])
def test_the_steps_of_a_coarse_sensor_are_no_outliers(step: float) -> None:
    coarse = np.round((noise() + np.linspace(0.0, 3.0, VALUES)[:, None]) / step) * step
    assert not np.any(find_outliers(coarse, coarse))
    assert not np.any(find_gross_outliers(coarse))


def test_missing_values_neither_count_nor_hide_an_outlier() -> None:
    values = noise()
    values[np.random.default_rng(3).random(values.shape) < 0.3] = np.nan
    values[99:106, 0] = [0.1, 0.2, np.nan, 8.0, np.nan, -0.1, 0.0]
    assert np.argwhere(find_outliers(values, values)).tolist() == [[102, 0]]


def test_left_out_is_as_missing_and_a_run_without_outliers_stays_itself() -> None:
    run = Run(np.arange(3.0), np.zeros((3, 1)), np.arange(6.0).reshape(3, 2), (1,))
    assert remove_outliers(run, np.zeros((3, 2), dtype=bool)) is run
    found = remove_outliers(run, np.array([[False, False], [False, True], [False, False]]))
    np.testing.assert_array_equal(found.measured, [[0.0, 1.0], [2.0, np.nan], [4.0, 5.0]])
    assert (found.values, found.breaks) == (5, (1,))
    begun = remove_outliers(run, np.array([[False, True], [False, False], [False, False]]))
    np.testing.assert_array_equal(begun.measured, [[np.nan, np.nan], [2.0, 3.0], [4.0, 5.0]])


def without_input() -> ProcessModel:
    """A tank whose inflow is a constant of its equations."""
    model = tank()
    return replace(model, inputs=(), rhs=(ca.substitute(model.rhs[0], model.inputs[0].symbol, 5.0),))


def with_second_input() -> ProcessModel:
    """A tank with another inflow, `v`."""
    model = tank()
    v = variable("v", "m", (0.0, 20.0), 1.0, "another inflow")
    return replace(model, inputs=(*model.inputs, v), rhs=(model.rhs[0] + RATE * v.symbol,))


def test_a_process_without_inputs_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match=r"needs a process with an input, tank has none; .*: make what moves"):
        make_run(tank_record(), without_input())


@pytest.mark.parametrize("late_rows", [0, 2], ids=["exact", "with nuisance"])
def test_causes_that_an_input_hides_that_never_moved_are_named(late_rows: int) -> None:
    record = tank_record(noise_sd=0.02)
    level = np.concatenate([np.full(late_rows, record.columns["h"][0]), record.columns["h"]])[: record.rows]
    still = replace(record, columns=record.columns | {"h": level, "v": np.zeros(record.rows)})
    found = diagnose(still, with_second_input(), (Gain(), Shift(), *input_effects("v")))
    (note,) = [remark for remark in found.remarks if "never moved" in remark]
    assert note.startswith("v (0) never moved, so these causes cannot be seen until it does: ")
    assert note.split(": ")[1] == "v.gain, v.lag, v.delay, v.stiction"


def test_of_a_record_with_fewer_rows_than_nuisance_the_needed_rows_are_stated() -> None:
    run = make_run(tank_record(), tank())
    assert describe_short_record(run, run.time_min.size) == []
    (remark,) = describe_short_record(run, 700)
    assert remark.startswith("600 rows are few for the 700 parameters of the nuisance, ")
    assert remark.endswith(": record at least 700 rows")


def input_effects(name: str) -> list[Effect]:
    return [effect for effect in generic_effects(with_second_input()) if effect.name.startswith(f"{name}.")]
