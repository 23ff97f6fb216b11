"""A diagnosis is held against the truth as a person would, on diagnoses made up for it."""

import numpy as np
import pytest
from msgspec.structs import replace

from reactorwatch.diagnosis.result import Alternative, Cause, Curves, Diagnosis, Estimate, Gain, HeldOut
from reactorwatch.records.record import Record
from tests.hidden_effect.catalogue import CATALOGUE, OUTSIDE
from tests.hidden_effect.courses import HiddenCourse
from tests.hidden_effect.draw import Hidden
from tests.hidden_effect.excitation import Circumstances
from tests.hidden_effect.judge import judge
from tests.hidden_effect.plant import Played

TIME = np.linspace(0.0, 10.0, 11)
EMPTY = Played(TIME, TIME, TIME, np.stack([TIME, TIME], axis=1))


def hidden(*names: str, size: float = 2.0, onset_min: float = 4.0) -> Hidden:
    """A step of each, in a record of which nothing else matters."""
    effects = tuple(item for item in CATALOGUE + OUTSIDE if item.name in names)
    courses = tuple(HiddenCourse("step", size, onset_min) for _ in effects)
    record = Record(TIME, {"T": 440.0 + np.where(TIME < 6.0, 0.36, 0.0)}, "made up")
    return Hidden(record, 1, Circumstances(), effects, courses, 1000.0, EMPTY, np.full((11, 2), 440.0))


def make_diagnosis(
    *names: str, verdict: str = "named", others: tuple[str, ...] = (), location: str = "feed"
) -> Diagnosis:
    """A diagnosis that names steps of 2.02 +- 0.02 at 4.5 +- 0.1 min."""
    parameters = {"size": Estimate(2.02, 0.02, "K"), "onset": Estimate(4.5, 0.1, "min")}

    def cause(name: str, profile: str) -> Cause:
        return Cause(cause=name, profile=profile, label="", location=location, parameters=parameters)

    curve = np.where(TIME >= 4.5, 2.02, 0.0)
    held_out = {"T": HeldOut(3.0, 0.33, 3.0, 0.33, 0.3, "K")}
    return Diagnosis(
        file="made up",
        zero=None,
        samples=11,
        runs=1,
        span_min=10.0,
        seconds=0.0,
        verdict=verdict,
        grade="",
        nearest=(),
        onset=None,
        nuisance=(),
        remaining={},
        causes=tuple(cause(name, "step") for name in names),
        alternatives=tuple(Alternative(tuple(cause(part, "ramp") for part in item.split("+")), 3.0) for item in others),
        location=location,
        locations=(),
        law=None,
        significant=True,
        practical=True,
        differences={},
        gain=Gain(100.0, held_out),
        adequacy={},
        experiment=None,
        extended_model={},
        curves=Curves(
            TIME, {}, {}, {}, {}, {}, {}, dict.fromkeys(names, curve), {}, held_out={"T": (TIME > 3.0) & (TIME < 8.0)}
        ),
    )


def test_the_right_name_is_first_and_its_numbers_are_compared() -> None:
    judged = judge(hidden("feed_temperature"), make_diagnosis("feed_temperature"), 1.0)
    assert judged.first
    assert judged.listed
    assert judged.right_place
    assert not judged.wrong
    assert judged.size_errors == pytest.approx((0.01,))
    assert judged.size_inside == (True,)
    assert judged.onset_errors == pytest.approx((0.5,))
    assert judged.onset_inside == (False,)
    assert judged.held_out == pytest.approx(1.1)
    assert judged.before == pytest.approx(10.0)


def test_beside_the_error_on_rows_not_seen_stands_the_noise_that_was_drawn_in_them() -> None:
    judged = judge(hidden("feed_temperature"), make_diagnosis("feed_temperature"), 1.0)
    assert judged.drawn == pytest.approx(1.2 * np.sqrt(0.5))  # of four rows two, by 1.2 standard deviations


def test_the_error_of_a_curve_is_relative_to_the_true_one() -> None:
    judged = judge(hidden("feed_temperature", onset_min=4.9), make_diagnosis("feed_temperature"), 1.0)
    # Of eleven rows six are past both onsets: 0.02 off there, where the truth is 2.
    assert judged.curve_errors == pytest.approx((0.01,))


def test_a_wrong_name_with_the_truth_among_the_alternatives_is_listed() -> None:
    judged = judge(
        hidden("feed_temperature"), make_diagnosis("coolant_flow", others=("feed_temperature", "heat_loss")), 1.0
    )
    assert not judged.first
    assert judged.listed
    assert judged.count == 3
    assert judged.called == "coolant_flow"
    assert judged.size_errors == ()


def test_one_of_two_causes_alone_is_not_what_is_hidden() -> None:
    truth = hidden("feed_temperature", "volume")
    assert not judge(truth, make_diagnosis("volume", others=("feed_temperature",)), 1.0).listed
    assert judge(truth, make_diagnosis("volume", others=("volume+feed_temperature",)), 1.0).listed
    assert judge(truth, make_diagnosis("volume", "feed_temperature"), 1.0).first


def test_no_cause_named_where_none_is_hidden_is_right_and_any_other_verdict_is_wrong() -> None:
    nominal = replace(make_diagnosis(verdict="nominal", location=""), significant=False)
    assert judge(hidden(), nominal, 1.0).first
    assert not judge(hidden(), nominal, 1.0).wrong
    for claim in (make_diagnosis("volume"), make_diagnosis(verdict="unknown", location="")):
        assert judge(hidden(), claim, 1.0).wrong
        assert not judge(hidden(), claim, 1.0).listed


def test_not_seeing_a_cause_is_a_miss_and_no_wrong_claim() -> None:
    judged = judge(hidden("volume"), make_diagnosis(verdict="nominal", location=""), 1.0)
    assert not judged.first
    assert not judged.wrong


def test_unknown_in_the_right_place_is_not_the_name_but_the_place() -> None:
    judged = judge(hidden("boiling"), make_diagnosis(verdict="unknown", location="energy_balance"), 1.0)
    assert judged.called == "unknown"
    assert judged.right_place
    assert not judged.first
