"""Text and JSON of a diagnosis."""

import json
import re

import msgspec
import pytest
from msgspec.structs import replace

from reactorwatch.diagnosis.result import Cause, Estimate, Nuisance
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cascaded_tanks import EFFECTS as TANK_EFFECTS
from reactorwatch.process.library.cstr import EFFECTS
from reactorwatch.sentences.diagnosis import (
    describe_correction,
    describe_size,
    describe_timing,
    describe_training,
    describe_verdict,
    diagnosis_text,
)
from reactorwatch.sentences.numbers import format_interval
from tests.unit.diagnosis.cases import ADJUSTED, CASES, ROWS


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ("nominal", "The simulation is right: the rest of the record is noise."),
        ("named", "The simulation is wrong: coolant leak, since 150.33 ± 0.02 min. It matters in practice."),
        (
            "pair",
            "The simulation is wrong: coolant leak, since 150.33 ± 0.02 min; and drift of the temperature sensor, "
            "growing since 20 ± 6 min. It matters in practice.",
        ),
        (
            "curve",
            "The simulation is wrong: wrong feed temperature, changing over the record, largest at 150.1 min. "
            "In practice the difference is too small to matter.",
        ),
        (
            "ambiguous",
            "The simulation is wrong, and the record cannot tell why: coolant leak (since 150.33 ± 0.02 min) or "
            "wrong feed temperature (since 150.1 ± 0.8 min). It matters in practice.",
        ),
        (
            "unknown",
            "The simulation is wrong, and no known cause explains it; an unknown deviation of a single place fits "
            "best in the energy balance (odds of over 100 to 1 against any other place). It matters in practice.",
        ),
        (
            "law",
            "The simulation is wrong, and no known cause explains it; an unknown deviation of a single place fits "
            "best in the energy balance (odds of 9.5 to 1 against the next, on the side of the coolant). A law "
            "explains it: a (T/440)^n, added to dT/dt. It matters in practice.",
        ),
        (
            "inexact",
            "The simulation is wrong: coolant leak, since 150.33 ± 0.02 min, or fouled jacket, which acts the same in "
            "this record. It matters in practice.",
        ),
        (
            "nearest",
            "The simulation is wrong, and no known cause explains it; an unknown deviation of a single place fits "
            "best in the energy balance (odds of over 100 to 1 against any other place). Nearest is wrong feed "
            "temperature, which removes 41 % of the squared error. It matters in practice.",
        ),
    ],
)
def test_the_verdict_is_a_sentence(case: str, expected: str) -> None:
    assert describe_verdict(CASES[case]) == expected


@pytest.mark.parametrize(
    ("estimate", "expected"),
    [
        (Estimate(-0.0499634, 8.5e-5, "1"), "-0.04996 ± 0.00017"),
        (Estimate(312.33, 0.1, "min"), "312.33 ± 0.20 min"),
        (Estimate(12345.6, 100.0, "K"), "12350 ± 200 K"),
        (Estimate(5.0, 0.0, "min"), "5 min"),
        (Estimate(5.0, float("nan"), "min"), "5 min"),
        (Estimate(5.0, float("inf"), "min"), "5 min"),
    ],
)
def test_a_number_has_the_digits_that_its_95_percent_interval_allows(estimate: Estimate, expected: str) -> None:
    assert format_interval(estimate) == expected


@pytest.mark.parametrize("effect", [*EFFECTS, *TANK_EFFECTS], ids=lambda effect: effect.name)
@pytest.mark.parametrize("profile", ["constant", "ramp", "decay", "sine", "free"])
def test_the_size_of_every_cause_is_stated_with_its_unit_and_meaning(effect: Effect, profile: str) -> None:
    for sign in (1.0, -1.0) if effect.lower < 0.0 else (1.0,):
        size = Estimate(sign * abs(effect.typical), 0.01 * abs(effect.typical), effect.unit)
        constants = {item.name: Estimate(item.value, item.sd, item.unit) for item in effect.constants}
        cause = Cause(
            cause=effect.name,
            profile=profile,
            label=effect.label,
            location=effect.location,
            parameters={"size": size} | constants,
        )
        stated = describe_size(cause, (effect,))
        unit = "%" if "%" in effect.larger else effect.unit
        value = abs(size.value) * (100.0 if unit == "%" else 1.0)
        number = re.search(r"-?\d[\d.]*", stated)
        assert number is not None
        assert abs(float(number.group())) == pytest.approx(value, rel=0.02)
        half = re.search(r"± ([\d.]+)", stated)
        assert half is not None
        assert float(half.group(1)) == pytest.approx(0.0196 * value, rel=0.3)
        assert unit in stated or unit == "1"
        if profile != "sine":
            assert "-" not in stated  # the words tell the direction
            words = effect.larger if sign > 0.0 else effect.smaller
            assert all(part.strip() in stated for part in words.split("{}"))


def test_more_and_less_have_different_words() -> None:
    for effect in (*EFFECTS, *TANK_EFFECTS):
        assert bool(effect.smaller) == (effect.lower < 0.0), effect.name
        assert effect.larger.count("{}") == 1
        assert effect.larger != effect.smaller


def test_people_read_sizes_onsets_rivals_experiment_gain_and_remarks() -> None:
    text = diagnosis_text(CASES["ambiguous"], EFFECTS)
    for part in (
        "run.csv: 2000 rows over 199.9 min",
        "either      coolant leak (coolant_flow, step): 4.996 % of the coolant lost (± 0.017 %), "
        "since 150.33 ± 0.02 min",
        "C off by 0.00202 mol/l, before 0.0147 mol/l; noise 0.00197 mol/l",
        "T off by 0.292 K, before none, it ran away; noise 0.303 K",
        "or          wrong feed temperature (feed_temperature, step): feed warmer by 1.23 K (± 0.10 K), since 150.1 ± "
        "0.8 min, less likely by odds of 5 to 1",
        "experiment  Wider steps of qc tell both apart.",
    ):
        assert part in text
    order = [text.index(part) for part in ("either", "  or  ", "experiment  ", "evidence  ", "held out  ")]
    assert order == sorted(order)
    assert "size        4.996 % of the coolant lost (± 0.017 %)  (95 %)" in diagnosis_text(CASES["named"], EFFECTS)
    assert "note        The record runs under <control>." in diagnosis_text(CASES["pair"], EFFECTS)


def test_with_nuisance_people_read_shares_probabilities_and_corrections_instead_of_bic() -> None:
    text = diagnosis_text(CASES["inexact"], EFFECTS)
    for part in (
        "share       removes 97 % of the squared error; 48 % likely against the other causes",
        "corrected   T is measured 2.00 ± 0.20 s after its stamp, C lags by 12 ± 2 s, volume 1.2 ± 0.4 %, "
        "qc acts 1.8 ± 0.6 s before its stamp relative to the outputs  (95 %)",
        "or          fouled jacket (heat_transfer, step): ",
        ", since 150.30 ± 0.20 min, which acts the same in this record",
        "next        wrong feed temperature (feed_temperature, step), which removes 41 % of the squared error; "
        "less than 1 % likely against the other causes",
    ):
        assert part in text
    right = replace(CASES["inexact"], verdict="nominal", grade="right", causes=(), alternatives=())
    assert describe_verdict(right) == (
        "The simulation is right but for small corrections: T is measured 2.00 ± 0.20 s after its stamp, "
        "C lags by 12 ± 2 s, volume 1.2 ± 0.4 %, qc acts 1.8 ± 0.6 s before its stamp relative to the outputs."
    )


@pytest.mark.parametrize("case", CASES)
def test_evidence_is_stated_in_odds_or_per_cent(case: str) -> None:
    assert "BIC" not in diagnosis_text(CASES[case], EFFECTS)


@pytest.mark.parametrize(
    ("profile", "expected"),
    [("step", "from the beginning"), ("ramp", "growing from the beginning"), ("decay", "settling from the beginning")],
)
def test_a_cause_that_may_have_been_there_from_the_first_row_has_no_onset(profile: str, expected: str) -> None:
    leak = replace(CASES["named"].causes[0], profile=profile, from_beginning=True)
    assert describe_timing(leak) == expected
    assert describe_timing(replace(leak, run=2)) == f"{expected} of run 2"


def test_outputs_that_differ_in_practice_have_a_line_each_and_the_others_are_counted() -> None:
    named = CASES["named"]
    few = {"C": replace(named.differences["C"], tolerance=9.0)}
    text = diagnosis_text(replace(named, differences=named.differences | few), EFFECTS)
    assert re.findall("differs     (.*)", text) == [
        "T by 1.54 K, 4 % of it noise; most from 149.9 to 174.9 min (3.04)",
        "1 other output by less than matters in practice",
    ]


@pytest.mark.parametrize(
    ("name", "minutes", "expected"),
    [
        ("T.delay", -0.1, "T is measured 6 s after its stamp"),
        ("T.delay", 0.1, "T is measured 6 s before its stamp"),
        ("qc.delay", -0.1, "qc acts 6 s before its stamp"),
        ("qc.delay", 0.1, "qc acts 6 s after its stamp"),
    ],
)
def test_a_delay_is_described_by_when_a_signal_is_measured_or_acts(name: str, minutes: float, expected: str) -> None:
    assert describe_correction(Nuisance(name, Estimate(minutes, 0.0, "min"), 0.1), ("C", "T")) == expected


def test_a_sound_simulation_that_errs_by_more_than_the_noise_is_right_with_a_reservation() -> None:
    nominal = CASES["nominal"]
    held_out = nominal.gain.held_out | {"T": replace(nominal.gain.held_out["T"], rmse_after=0.6)}
    assert describe_verdict(replace(nominal, gain=replace(nominal.gain, held_out=held_out))) == (
        "The simulation is right as far as this record tells: T differs by more than the noise of the sensor, but no "
        "cause explains that better than disturbances of the process do."
    )


def test_places_are_compared_with_the_best() -> None:
    expected = "where       in the energy balance; on the side of the coolant, less likely by odds of 9.5 to 1"
    assert expected in diagnosis_text(CASES["law"], EFFECTS)


def test_an_unknown_lists_what_comes_nearest() -> None:
    text = diagnosis_text(CASES["nearest"], EFFECTS)
    assert "nearest     wrong feed temperature (feed_temperature, step): feed warmer by 1.23 K" in text
    assert "removes 41 % of the squared error" in text
    assert "evidence" not in text  # nothing extends the simulation


def test_a_training_names_the_place_of_what_it_cannot_explain() -> None:
    assert describe_training(CASES["unknown"]) == (
        "the training deviates from the equations, and no cause of the catalogue explains it; an unknown deviation of "
        "a single place fits best in the energy balance (odds of over 100 to 1 against any other place)"
    )


@pytest.mark.parametrize("case", CASES)
def test_the_object_has_the_keys_that_are_promised_and_nothing_else(case: str) -> None:
    stated = json.loads(msgspec.json.encode(CASES[case].to_dict()))
    assert list(stated) == [
        "file", "zero", "samples", "runs", "span_min", "seconds", "verdict", "grade", "causes", "alternatives",
        "nearest", "onset", "nuisance", "remaining", "location", "locations", "law", "significant", "practical",
        "gain", "adequacy", "experiment", "extended_model",
    ]  # fmt: skip
    for item in stated["gain"]["held_out"].values():
        assert list(item) == ["rmse_before", "rmse_after", "noise_sd", "unit"]
    for cause in [*stated["causes"], *(cause for item in stated["alternatives"] for cause in item["causes"])]:
        assert list(cause) == ["cause", "profile", "label", "location", "parameters", "share", "probability"]
        assert next(iter(cause["parameters"])) == "size"
        assert all(list(item) == ["value", "sd", "unit"] for item in cause["parameters"].values())


def test_a_law_has_its_intervals_its_rivals_and_its_range() -> None:
    law = CASES["law"].to_dict()["law"]
    assert (law["location"], law["form"], law["formula"]) == ("energy_balance", "power", "a (T/440)^n")
    assert law["parameters"]["n"] == {"value": 4.1, "sd": 0.2, "unit": "1"}
    assert law["rivals"] == [{"location": "coolant", "form": "linear", "formula": "a + b (qc - 100)", "delta_bic": 4.5}]
    assert law["range"] == {"T": [425.0, 452.0]}
    assert law["held_out"]["T"]["rmse_after"] == 0.301
    text = diagnosis_text(CASES["law"], EFFECTS)
    for part in (
        "a (T/440)^n",
        "4.1 ± 0.4",
        "425 to 452",
        "less likely by odds of 9.5 to 1",
        "correlation 0.97 with Tf",
    ):
        assert part in text


def test_the_object_holds_what_was_found() -> None:
    stated = CASES["ambiguous"].to_dict()
    assert stated["causes"][0]["parameters"]["onset"] == {"value": 150.3349, "sd": 0.0122, "unit": "min"}
    (alternative,) = stated["alternatives"]
    assert alternative["delta_bic"] == 3.21
    assert alternative["causes"][0]["cause"] == "feed_temperature"
    assert alternative["causes"][0]["parameters"]["size"] == {"value": 1.234, "sd": 0.05, "unit": "K"}
    assert stated["experiment"] == {
        "why": "Wider steps of qc tell both apart.",
        "input": [[0.0, 103.4], [10.0, 90.0]],
        "separates": ["coolant_flow", "feed_temperature"],
        "signal": "qc",
        "span_min": 20.0,
        "expected_delta_bic": 42.0,
        "probability": 0.994,
        "limits": {"qc": [85.0, 115.0], "C": [0.05, 0.2], "T": [425.0, 455.0]},
        "expected": [{"between": ["coolant_flow", "feed_temperature"], "delta_bic": 42.0, "probability": 0.994}],
        "predicted": {
            "coolant_flow": {"C": [0.06, 0.1], "T": [438.5, 448.7]},
            "feed_temperature": {"C": [0.06, 0.11], "T": [438.4, 448.8]},
        },
    }
    assert stated["adequacy"]["T"] == {"minus_log10_p": 0.35}
    assert stated["gain"]["held_out"]["T"]["rmse_before"] is None  # it ran away
    assert CASES["nominal"].to_dict()["location"] is None


def test_an_uncertain_parameter_is_reported_with_its_posterior() -> None:
    assert describe_verdict(ADJUSTED) == (
        "The simulation is right within what was stated of its parameters: K3 is a little off, "
        "and the rest of the record is noise."
    )
    assert "parameter   K3 711 ± 3 l/min; stated: 700 ± 30 l/min  (95 %)" in diagnosis_text(ADJUSTED, EFFECTS)
    stated = ADJUSTED.to_dict()["parameters"]
    assert list(stated) == ["K3", "Tf"]
    assert stated["K3"] == {"nominal": 700.0, "stated_sd": 14.0, "value": 711.2, "sd": 1.5, "unit": "l/min"}


@pytest.mark.parametrize("case", CASES)
def test_the_report_for_machines_adds_where_the_simulation_differs(case: str) -> None:
    stated = json.loads(msgspec.json.encode(CASES[case].to_dict("differences")))
    assert stated.keys() - CASES[case].to_dict().keys() == {"differences"}
    for name, item in stated["differences"].items():
        assert item["unit"] == CASES[case].gain.held_out[name].unit
        assert sum(part["rows"] for part in item["along"]["time"]) == ROWS
