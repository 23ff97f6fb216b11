"""A record of several runs is diagnosed as such: each starts from a state of its own, times are those of its run."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.holdout import OBSERVED_ROWS, holdout_rows
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.errors import InputError
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record, join_runs
from reactorwatch.sentences.diagnosis import diagnosis_text
from tests.unit.diagnosis.runs import record_of
from tests.unit.process.effect_named import effect_of

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
