"""The study scores what was judged, draws each cause as often, and writes it down."""

from dataclasses import replace
from math import nan
from pathlib import Path

import numpy as np
import pytest

from benchmarks.diagnosis_study import judge_record, section
from benchmarks.harness.study import Pool, replace_between
from benchmarks.hidden.classes import CLASSES, NEARLY, draw_record, find_class, seed_of
from benchmarks.hidden.score import (
    SuspectsJudged,
    confusion,
    failures,
    main_table,
    percent,
    reliability_table,
    score,
)
from reactorwatch.errors import InputError
from tests.hidden_effect.draw import draw
from tests.hidden_effect.excitation import MEDIUM_NOISE
from tests.hidden_effect.judge import Judged


def one(truth: str, said: str, **more: object) -> Judged:
    """A judged record, by names alone."""
    found = Judged(1, (truth,) if truth else (), ("step",) if truth else (), (2.0,) if truth else (), 1000.0)
    told = {"verdict": "named" if said else "nominal", "said": (said,) if said else (), "profiles": ("step",)}
    return Judged(**(found.__dict__ | told | {"first": truth == said, "listed": truth == said, "count": 1} | more))


def test_shares_are_shares_of_all_records_and_a_diagnosis_that_failed_is_a_miss() -> None:
    found = score([one("a", "a"), one("a", "b", listed=True, count=3), one("b", ""), one("b", "b")])
    assert [found[name].split()[0] for name in ("first %", "listed %", "list", "wrong %")] == [
        *("50.0", "75.0", "1.50", "25.0")
    ]
    found = score([one("a", "a"), one("a", "", verdict="", remark="InputError: no")])
    assert (found["first %"].split()[0], found["errors"]) == ("50.0", "1")


def test_a_quantile_is_a_value_that_occurred_and_what_is_no_number_counts_as_the_worst() -> None:
    assert score([one("a", "a", held_out=value) for value in (1.0, 1.1, 1.2, nan)])["/ its sd"] == "1.100 / inf"


def test_an_error_is_compared_with_the_noise_of_its_own_rows() -> None:
    errors = ((0.9, 0.9), (1.1, 1.1), (1.02, 1.0))  # in standard deviations: of what was found, of the truth
    found = score([one("a", "a", held_out=error, drawn=drawn) for error, drawn in errors])
    assert [found[name] for name in ("held-out T / noise drawn", "/ its sd", "the truth's")] == [
        *("1.000 / 1.020", "1.020 / 1.100", "1.000 / 1.100")
    ]


def test_the_confusion_table_counts_what_each_truth_was_called() -> None:
    found = dict(confusion([one("a", "a"), one("a", "b"), one("a", "a"), one("", "")]))
    assert found == {"a": [("a", 2), ("b", 1)], "nominal": [("nominal", 1)]}


def test_a_share_has_the_interval_of_its_number_of_records() -> None:
    """Wilson's interval of 9 in 10: 0.596 to 0.982 (Brown, Cai & DasGupta 2001, Statistical Science 16, formula 4)."""
    assert percent([True] * 9 + [False]) == "90.0 (60–98)"
    assert percent([]) == "–"
    assert percent([True] * 50) == f"100.0 ({100 / (1.0 + 1.959964**2 / 50):.0f}–100)"


def test_the_table_of_reliability_counts_what_was_right_at_each_stated_probability() -> None:
    exact = [one("a", "a", size_scores=(z,), probability=0.99) for z in (0.1, 0.6, 1.0, 1.7)]
    wrong = one("a", "b", probability=0.6)
    suspects = [SuspectsJudged("a", True, 0.7, right, True) for right in (True, False)]
    table = reliability_table({"medium": [*exact, wrong]}, suspects)
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]
    right = {tuple(row[:3]): row[3].split()[0] for row in cells}
    assert right["the model itself", "size in its interval", "50"] == "50.0"
    assert right["the model itself", "size in its interval", "90"] == "75.0"
    assert right["the model itself", "size in its interval", "95"] == "100.0"
    assert right["the model itself", "verdict", "99"] == "100.0"
    assert right["the model itself", "verdict", "60"] == "0.0"
    assert right["not quite the model", "first suspect", "70"] == "50.0"
    assert right["not quite the model", "cause in the set of suspects", "90"] == "100.0"


def test_a_plant_that_is_not_quite_the_model_differs_from_it_by_less_than_is_worth_finding() -> None:
    circumstances = find_class(NEARLY).circumstances(0)
    nearly, exact = (draw(7, (), replace(circumstances, background=share)) for share in (circumstances.background, 0.0))
    apart = np.sqrt(np.mean((nearly.shown - exact.shown) ** 2, axis=0)) / MEDIUM_NOISE
    assert 0.02 < np.max(apart) < 1.0
    assert draw_record(find_class(NEARLY), 0, 50_000_000).circumstances == circumstances


def test_causes_take_turns() -> None:
    study = find_class("150 min")
    found = [draw_record(study, number, 50_000_000).causes[0] for number in range(6)]
    assert len(set(found)) >= 5  # one that cannot show gives way to the next


def test_no_two_records_of_a_study_share_a_seed() -> None:
    seeds = [seed_of(study, number, 1) for study in CLASSES for number in (0, 1, 99_999)]
    assert len(set(seeds)) == len(seeds)


def test_a_study_that_was_stopped_continues_from_the_file_of_its_results(tmp_path: Path) -> None:
    """The judged record is taken from the file, and what was half written when it was stopped is computed again."""
    jobs, file = [("150 min", 1, 60_000_000)], tmp_path / "results"
    found = {"150 min": Pool(1, results=file).run("150 min", judge_record, jobs)}
    assert found["150 min"][0].remark == ""
    assert main_table(found) in section(found, 60_000_000)
    whole = file.read_bytes()
    file.write_bytes(whole + whole[:100])
    assert Pool(1, results=file).run("150 min", _refuse, jobs) == found["150 min"]
    with pytest.raises(RuntimeError, match="not there yet"):
        Pool(1, results=file).run("150 min", _refuse, [("150 min", 2, 60_000_000)])


def _refuse(job: tuple[str, int, int]) -> Judged:
    raise InputError(f"{job[1]} is not there yet")


def test_tables_take_the_place_of_those_before_and_a_page_without_marks_is_refused(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- begin -->\nold\n<!-- end -->\nafter\n", encoding="utf-8")
    for _ in range(2):
        replace_between(page, "<!-- begin -->", "<!-- end -->", "new\n")
        assert page.read_text(encoding="utf-8") == "before\n<!-- begin -->\nnew\n<!-- end -->\nafter\n"
    with pytest.raises(ValueError, match="must hold the marks"):
        replace_between(page, "<!-- start -->", "<!-- end -->", "new")


def test_what_has_no_name_fails_where_it_is_not_in_its_place() -> None:
    unknown = {"verdict": "unknown", "profiles": ()}
    found = [one("x", "", right_place=True, **unknown), one("x", "", seed=2, **unknown)]
    (line,) = failures({"outside": found})
    assert "seed 2" in line
