"""Diagnoses of records with any number of faults, of several runs, with any catalogue, by a limited effort."""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.holdout import OBSERVED_ROWS, holdout_rows
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.report.page import as_page
from reactorwatch.diagnosis.result import AMBIGUOUS, NAMED, NOMINAL, UNKNOWN
from reactorwatch.errors import InputError
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.error_dynamics import ErrorLinearization
from reactorwatch.process import effects_of
from reactorwatch.process.effect import Effect
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.library.cstr import cstr
from reactorwatch.progress import reporting_to
from reactorwatch.records.record import Record, join_runs
from reactorwatch.sentences.diagnosis import diagnosis_text
from tests.tables import read_csv
from tests.unit.diagnosis.linear_tank import PERIOD_MIN, Gain, Shift, tank, tank_record
from tests.unit.diagnosis.runs import record_of
from tests.unit.process.effect_named import effect_of


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
        (lambda r: changed(r, C=np.full(r.rows, np.nan)), "C needs at least 20 values"),
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


ROWS, FIRST = 1600, 900
ONSET_MIN = 120.0
CATALOGUE = [effect_of("coolant_flow")]


@pytest.fixture(scope="module")
def sound() -> Record:
    return record_of(seed=3, rows=ROWS)


@pytest.fixture(scope="module")
def leaking() -> Record:
    return record_of(f"coolant_flow:step:-0.1@{ONSET_MIN}min", seed=3, rows=ROWS)


def set_back(record: Record, by_min: float) -> Record:
    """The record with its clock set back within it."""
    times = record.time_min - np.where(np.arange(record.rows) < FIRST, 0.0, by_min)
    return replace(record, time_min=times, runs=1 + (np.arange(record.rows) >= FIRST))


def sessions(*seeds: int, start_min: float = 0.0) -> Record:
    """A plant that was started several times, each from its rest."""
    parts = [record_of(seed=seed, rows=700) for seed in seeds]
    return join_runs([replace(part, time_min=part.time_min + start_min * n) for n, part in enumerate(parts)])


@pytest.mark.parametrize("by_min", [0.05, 60.0, 60.05, 2000.0])
def test_a_sound_plant_whose_clock_was_set_back_is_sound(sound: Record, by_min: float) -> None:
    found = diagnose(set_back(sound, by_min), cstr(), CATALOGUE)
    assert (found.verdict, found.practical, found.runs, found.samples) == ("nominal", False, 2, ROWS)


@pytest.mark.parametrize("start_min", [-10.0, 40.0, 1000.0])
def test_a_plant_that_was_started_again_is_sound(start_min: float) -> None:
    found = diagnose(sessions(1, 2, start_min=start_min), cstr(), CATALOGUE)
    assert (found.verdict, found.practical) == ("nominal", False)
    assert found.span_min == pytest.approx(2 * 69.9)


@pytest.mark.parametrize("by_min", [60.0, 60.05])
def test_a_fault_is_found_at_the_minute_that_the_clock_showed(leaking: Record, by_min: float) -> None:
    record = set_back(leaking, by_min)
    found = diagnose(record, cstr(), CATALOGUE)
    (cause,) = found.causes
    assert (cause.cause, cause.run, found.runs) == ("coolant_flow", 2, 2)
    assert cause.to_dict()["run"] == 2
    assert cause.parameters["onset"].value == pytest.approx(ONSET_MIN - by_min, abs=0.1)
    extended = parse_extended_model(msgspec.json.encode(found.extended_model))
    assert extended.effects[0].values["onset"] == cause.parameters["onset"].value
    text = diagnosis_text(found, CATALOGUE)
    assert "of run 2" in text
    assert "2 runs" in text


@pytest.mark.parametrize("lengths", [(1, 1, 2, 3), (20, 1, 150), (2, 500, 1)])
def test_runs_of_a_few_rows_hide_no_fault(leaking: Record, lengths: tuple[int, ...]) -> None:
    """Values are also missing in their first rows."""
    ends = 300 + np.cumsum(lengths)
    runs = 1 + np.searchsorted([300, *ends], np.arange(ROWS), side="right")
    columns = {name: values.copy() for name, values in leaking.columns.items()}
    columns["C"][ends - 1] = columns["T"][300] = np.nan
    found = diagnose(replace(leaking, runs=runs, columns=columns), cstr(), CATALOGUE)
    assert found.runs == len(lengths) + 2
    assert found.causes[0].parameters["onset"].value == pytest.approx(ONSET_MIN, abs=0.1)
    assert all(np.isfinite(item.rmse_after) for item in found.gain.held_out.values())


def test_nothing_is_judged_where_the_free_run_is_still_looking_for_the_state() -> None:
    record = sessions(1, 2)
    run = make_run(record, cstr())
    assert run.starts == (700,)
    assert 700 in run.breaks
    held_out = holdout_rows(run)
    assert not held_out[700 : 700 + OBSERVED_ROWS].any()
    assert held_out[700:].any()


def test_an_input_is_not_carried_over_from_one_run_to_the_next() -> None:
    record = sessions(1, 2)
    record.columns["qc"][700] = np.nan
    with pytest.raises(InputError, match="qc must be there in the first row of each run"):
        make_run(record, cstr())


@pytest.mark.parametrize(
    ("effects", "gain", "verdict"),
    [
        (None, 1.0, NOMINAL),
        (
            None,
            1.2,
            AMBIGUOUS,
        ),  # the gain of the input is one over the outflow's and the area's: two more causes do that
        ((), 1.0, NOMINAL),
        ((), 1.2, UNKNOWN),
        ((Shift(),), 1.0, NOMINAL),
        ((Shift(),), 1.2, UNKNOWN),  # a free shift does what another gain does, but a law with one parameter does, too
    ],
)
def test_a_model_of_ones_own_is_diagnosed_with_whatever_catalogue(
    effects: Sequence[Effect] | None, gain: float, verdict: str
) -> None:
    model = tank()
    found = diagnose(tank_record(gain=gain), model, effects)
    named = effects_of(model) if effects is None else effects
    assert (found.verdict, bool(found.causes)) == (verdict, verdict in (NAMED, AMBIGUOUS))
    assert found.significant == found.practical == (verdict != NOMINAL)
    assert json.loads(json.dumps(found.to_dict()))["verdict"] == verdict
    assert diagnosis_text(found, named).startswith(found.file)
    assert as_page(found, model, named, "a.csv", "m.json", "x.csv", on_the_bus=False).startswith("<!doctype html>")


@pytest.mark.parametrize(
    "names",
    [
        ("valve_stiction",),
        *(
            pytest.param(names, marks=pytest.mark.slow)
            for names in ((), ("jacket_lag", "temperature_lag"), ("concentration_delay",))
        ),
    ],
)
def test_what_a_small_catalogue_does_not_explain_is_unknown(names: tuple[str, ...]) -> None:
    record = record_of("coolant_flow:step:-0.05@30min", "temperature_bias:step:2@20min", rows=450)
    found = diagnose(record, cstr(), [effect_of(name) for name in names])
    assert (found.verdict, found.causes) == (UNKNOWN, ())
    assert found.location


@dataclass(frozen=True)
class Effort:
    """Largest numbers of filter runs and of linearisations."""

    runs: int
    linearisations: int


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    counts: Counter[str] = Counter()
    run, linearise = Filter.run_batched, ErrorLinearization.dynamics

    def count_run(self, record, start=None):  # type: ignore[no-untyped-def]
        counts["runs"] += 1
        return run(self, record, start)

    def count_linearisation(self, *items, **named):  # type: ignore[no-untyped-def]
        counts["linearisations"] += 1
        return linearise(self, *items, **named)

    monkeypatch.setattr(Filter, "run_batched", count_run)
    monkeypatch.setattr(ErrorLinearization, "dynamics", count_linearisation)
    return counts


@pytest.mark.parametrize(
    ("faults", "effort"),
    [
        ((), Effort(110, 6)),
        (("coolant_flow:step:-0.05@30min",), Effort(300, 60)),
        (("coolant_flow:step:-0.05@30min", "temperature_bias:ramp:2@20min,end=90min"), Effort(900, 260)),
    ],
    ids=("nominal", "one cause", "pair"),
)
def test_a_diagnosis_is_a_limited_effort(faults: tuple[str, ...], effort: Effort, counted: Counter[str]) -> None:
    found = diagnose(record_of(*faults, rows=900), cstr())
    assert len(found.causes) == len(faults)
    assert counted["runs"] <= effort.runs
    assert counted["linearisations"] <= effort.linearisations


STAGES = (
    "estimating the noise",
    "screening causes (2)",
    "looking for an unknown, place",
    "fitting pair",
    "comparing with nuisance, round",
    "fitting with nuisance, hypothesis",
)


def test_a_diagnosis_reports_its_stages_in_order_with_counts(capfd: pytest.CaptureFixture[str]) -> None:
    record = tank_record(noise_sd=0.02)
    late = replace(record, columns=record.columns | {"h": np.interp(record.time_min - 2 * PERIOD_MIN, *_level(record))})
    reported: list[tuple[str, int, int]] = []
    with reporting_to(lambda *stage: reported.append(stage)):
        diagnose(late, tank(), (Gain(), Shift()))
    assert list(dict.fromkeys(stage for stage, _, _ in reported if stage in STAGES)) == list(STAGES)
    for stage in STAGES[2:]:
        counts = [(step, steps) for name, step, steps in reported if name == stage]
        assert counts[0][0] == 1
        assert all(step <= steps for step, steps in counts)
        assert all(after in (before + 1, 1) for (before, _), (after, _) in pairwise(counts))
    assert capfd.readouterr() == ("", "")


def _level(record: Record) -> tuple[Array, Array]:
    return record.time_min, record.columns["h"]
