"""The study scores what was judged, draws each cause as often, and writes it down."""

import json
from dataclasses import replace
from math import isnan, nan
from pathlib import Path

import numpy as np
import pytest

from benchmarks.diagnosis_study import earlier, section, with_section
from benchmarks.diagnosis_study import judge_record as run_one
from benchmarks.hidden.classes import CLASSES, NEARLY, draw_record, find_class, seed_of
from benchmarks.hidden.reliability import reliability_table
from benchmarks.hidden.score import Score, Share, confusion
from benchmarks.hidden.suspects import SuspectsJudged
from benchmarks.hidden.tables import failures, main_table, percent
from tests.hidden_effect.draw import draw
from tests.hidden_effect.excitation import MEDIUM_NOISE
from tests.hidden_effect.judge import Judged


def one(truth: str, said: str, **more: object) -> Judged:
    """A judged record, by names alone."""
    found = Judged(1, (truth,) if truth else (), ("step",) if truth else (), (2.0,) if truth else (), 1000.0)
    told = {"verdict": "named" if said else "nominal", "said": (said,) if said else (), "profiles": ("step",)}
    return Judged(**(found.__dict__ | told | {"first": truth == said, "listed": truth == said, "count": 1} | more))


def test_shares_are_shares_of_all_records() -> None:
    score = Score.of([one("a", "a"), one("a", "b", listed=True, count=3), one("b", ""), one("b", "b")])
    assert score.first == 0.5
    assert score.listed == 0.75
    assert score.count == 1.5
    assert score.wrong == 0.25


def test_a_quantile_is_a_value_that_occurred_and_what_is_no_number_counts_as_the_worst() -> None:
    score = Score.of([one("a", "a", held_out=value) for value in (1.0, 1.1, 1.2, nan)])
    assert score.held_out_in_sd == (1.1, np.inf)


def test_an_error_is_compared_with_the_noise_of_its_own_rows() -> None:
    errors = ((0.9, 0.9), (1.1, 1.1), (1.02, 1.0))  # in standard deviations: of what was found, of the truth
    score = Score.of([one("a", "a", held_out=found, drawn=drawn) for found, drawn in errors])
    assert score.held_out == (1.0, 1.02)
    assert score.held_out_in_sd == (1.02, 1.1)
    assert score.drawn_in_sd == (1.0, 1.1)


def test_where_there_is_nothing_there_is_no_score() -> None:
    assert isnan(Score.of([]).first)


def test_a_diagnosis_that_came_to_no_end_counts_as_a_miss() -> None:
    score = Score.of([one("a", "a"), one("a", "", verdict="", remark="InputError: no")])
    assert score.first == 0.5
    assert score.errors == 1


def test_the_confusion_table_counts_what_each_truth_was_called() -> None:
    found = dict(confusion([one("a", "a"), one("a", "b"), one("a", "a"), one("", "")]))
    assert found == {"a": [("a", 2), ("b", 1)], "nominal": [("nominal", 1)]}


def test_a_failure_is_reported_with_its_seed() -> None:
    (line,) = failures({"medium": [one("a", "a"), one("a", "b")]})
    assert "seed 1" in line
    assert "a step 2 " in line
    assert "named b step" in line


def test_a_share_has_the_interval_of_its_number_of_records() -> None:
    assert percent(Share.of([True] * 9 + [False])) == "90.0 (60–98)"
    assert percent(Share.of([])) == "–"
    assert Share.of([True] * 50).interval == pytest.approx((1.0 / (1.0 + 1.959964**2 / 50), 1.0))


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


def test_a_record_goes_through_and_comes_out_as_tables_that_can_be_put_together_later(tmp_path: Path) -> None:
    found = {"150 min": [run_one("150 min", 1, 60_000_000)]}
    assert found["150 min"][0].remark == ""
    text = section(found, 60_000_000)
    assert main_table(found) in text
    assert "60000000" in text
    file = tmp_path / "numbers.json"
    file.write_text(json.dumps({"150 min": [found["150 min"][0].__dict__]}))
    assert section(earlier([file])[0], 60_000_000) == text


def test_the_tables_take_the_place_of_those_before() -> None:
    page = "before\n<!-- made by make study: begin -->\nold\n<!-- made by make study: end -->\nafter\n"
    once = with_section(page, "new\n")
    assert once == page.replace("old", "new")
    assert with_section(once, "new\n") == once


def test_a_page_without_the_marks_is_left_alone() -> None:
    with pytest.raises(ValueError, match="must hold the marks"):
        with_section("no marks", "new")


def test_nothing_is_hidden_in_a_nominal_record() -> None:
    assert draw_record(find_class("nominal"), 8, 70_000_000).causes == ()


def test_an_unknown_class_is_refused_with_the_names_of_those_there_are() -> None:
    with pytest.raises(KeyError, match=r"no class .easy.*closed loop"):
        find_class("easy")


def test_what_has_no_name_fails_where_it_is_not_in_its_place() -> None:
    unknown = {"verdict": "unknown", "profiles": ()}
    found = [one("x", "", right_place=True, **unknown), one("x", "", seed=2, **unknown)]
    (line,) = failures({"outside": found})
    assert "seed 2" in line
