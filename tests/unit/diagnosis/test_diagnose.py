"""Diagnoses of records with one fault, with two, without any, or with one that no catalogue has."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.result import NAMED, NOMINAL, UNKNOWN
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record
from tests.tables import read_csv
from tests.unit.diagnosis.runs import record_of


def test_a_sound_record_is_reported_as_nominal() -> None:
    found = diagnose(record_of(rows=2000), cstr())
    assert (found.verdict, found.causes, found.significant, found.practical) == (NOMINAL, (), False, False)
    assert found.gain.held_out["T"].rmse_before == pytest.approx(0.3, rel=0.15)


def test_the_curves_mark_the_values_of_the_held_out_errors() -> None:
    record = record_of(rows=2000)
    record.columns["T"][990:1010] = np.nan
    found = diagnose(record, cstr())
    assert found.curves is not None
    for name, gain in found.gain.held_out.items():
        values = found.curves.held_out[name]
        off = (record.columns[name] - found.curves.simulated_before[name])[values]
        assert off.size >= 300
        assert gain.rmse_before == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-12)


@pytest.mark.parametrize(
    ("fault", "size", "onset"),
    [
        ("coolant_flow:step:-0.03@100.37min", -0.03, 100.37),
        ("heat_transfer:ramp:-0.4@60min,end=199.9min", -0.4, 60.0),
        ("temperature_lag:constant:0.1", 0.1, None),
        ("concentration_delay:step:0.3@90min", 0.3, 90.0),
    ],
)
def test_one_cause_is_named_with_an_interval_that_holds_it(fault: str, size: float, onset: float | None) -> None:
    found = diagnose(record_of(fault, rows=2000), cstr())
    (cause,) = found.causes
    assert (found.verdict, cause.cause, cause.profile) == (NAMED, *fault.split(":")[:2])
    said = cause.parameters["size"]
    assert abs(said.value - size) < 4 * said.sd
    if onset is not None:
        assert cause.parameters["onset"].value == pytest.approx(onset, abs=3.0)
    for held_out, noise in (found.gain.held_out["C"], 0.002), (found.gain.held_out["T"], 0.3):
        assert held_out.rmse_after < 1.1 * noise
        assert held_out.rmse_after <= held_out.rmse_before


def test_two_causes_are_named_together() -> None:
    found = diagnose(record_of("coolant_flow:step:-0.02@120min", "temperature_bias:constant:1.5", rows=2500), cstr())
    assert found.verdict == NAMED
    assert sorted(cause.cause for cause in found.causes) == ["coolant_flow", "temperature_bias"]


@pytest.mark.slow
def test_what_no_cause_explains_is_unknown() -> None:
    record = record_of(rows=2000)
    T = record.columns["T"]
    bowed = T + 0.05 * (T - 440.0) ** 2
    found = diagnose(replace(record, columns=record.columns | {"T": bowed}), cstr())
    assert (found.verdict, found.causes, found.significant) == (UNKNOWN, (), True)
    assert found.practical


def test_a_tolerance_decides_what_matters_in_practice() -> None:
    record = record_of("temperature_bias:constant:0.2", rows=2000)
    fine, coarse = (diagnose(record, cstr(), tolerance={"T": value, "C": 0.01}) for value in (0.1, 0.5))
    assert (fine.verdict, coarse.verdict) == (NAMED, NAMED)
    assert (fine.practical, coarse.practical) == (True, False)


@pytest.mark.slow
def test_the_measured_record_differs_from_the_simulation_by_what_an_integrator_does(daisy_csv: Path) -> None:
    record = read_csv(daisy_csv)
    first = {name: values[:1000] for name, values in record.columns.items()}
    found = diagnose(replace(record, time_min=record.time_min[:1000], columns=first), cstr())
    assert (found.significant, found.practical, found.location) == (True, False, "timing")


def changed(record: Record, **columns: Array) -> Record:
    return replace(record, columns=record.columns | columns)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda r: Record(r.time_min[:50], {k: v[:50] for k, v in r.columns.items()}, r.name), "at least 200 rows"),
        (lambda r: changed(r, T=np.full(r.rows, 440.0)), "T must vary"),
        (lambda r: changed(r, T=r.columns["T"] - 273.15), "degrees C"),
        (lambda r: changed(r, qc=np.full(r.rows, 100.0)), "qc must move"),
        (lambda r: changed(r, C=np.full(r.rows, np.nan)), "C needs at least 100 values"),
        (lambda r: Record(r.time_min, {"qc": r.columns["qc"], "T": r.columns["T"]}, r.name), "C is not there"),
    ],
)
def test_a_record_that_cannot_be_diagnosed_is_refused_in_one_line(spoil: Callable[[Record], Record], said: str) -> None:
    with pytest.raises(InputError, match=said):
        diagnose(spoil(record_of(rows=400)), cstr())


@pytest.mark.parametrize(("tolerance", "said"), [({"p": 1.0}, "must be of C, T"), ({"T": -1.0}, "positive")])
def test_a_tolerance_has_to_be_of_an_output_and_positive(tolerance: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        diagnose(record_of(rows=400), cstr(), tolerance=tolerance)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda r: changed(r, qc=0.06 * r.columns["qc"]), r"qc must be in l/min; .* times 16\.67 it would"),
        (lambda r: changed(r, qc=r.columns["qc"] / 1000), r"qc must be in l/min; .* times 1000 it would"),
        (lambda r: changed(r, T=1.8 * r.columns["T"] - 459.67), "T must be in K; .* taken as degrees F it would"),
        (lambda r: replace(r, time_min=60 * r.time_min), "they are 6 min apart, .*; check the unit of the times"),
        (lambda r: replace(r, time_min=r.time_min / 60), "it lasts 0.665 min; check the unit of the times"),
        (lambda r: changed(r, qc=np.where(np.arange(r.rows) == 9, 100.0, 100.0 + 1e-6)), "qc must move"),
        (lambda r: changed(r, C=-r.columns["C"]), r"C must be in \[0, 2\] mol/l"),
        (
            lambda r: changed(r, qc=np.where(r.time_min < 1, np.nan, r.columns["qc"])),
            "qc must be there in the first row",
        ),
    ],
)
def test_another_unit_is_reported_with_its_cure(spoil: Callable[[Record], Record], said: str) -> None:
    with pytest.raises(InputError, match=said):
        diagnose(spoil(record_of(rows=400)), cstr())


@pytest.mark.parametrize(
    "fault",
    [
        "heat_transfer:constant:-0.4",
        "feed_concentration:constant:-0.3",
        "coolant_temperature:constant:25",
        "temperature_bias:constant:15",
        "reaction_rate:constant:-0.5",
    ],
)
def test_a_gross_cause_is_not_taken_for_a_wrong_unit(fault: str) -> None:
    make_run(record_of(fault, rows=400), cstr())


def test_a_short_record_has_rows_held_out_too() -> None:
    found = diagnose(record_of(rows=220), cstr())
    assert found.gain.held_out["T"].rmse_before == pytest.approx(0.3, rel=0.4)
