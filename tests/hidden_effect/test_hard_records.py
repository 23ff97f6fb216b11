"""Promises for hard records (docs/diagnosis.md): nominal ones stay nominal, and no cause is named wrongly alone."""

from dataclasses import replace

import numpy as np
import pytest

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.result import NOMINAL, Diagnosis
from reactorwatch.process.library.cstr import cstr
from tests.hidden_effect.catalogue import named
from tests.hidden_effect.draw import Hidden, draw
from tests.hidden_effect.excitation import NAMED_CIRCUMSTANCES, Circumstances
from tests.hidden_effect.judge import judge

SEED = 20_000_300
CASES = NAMED_CIRCUMSTANCES | {
    "finely quantised": Circumstances(resolution=(0.001, 0.15)),
    "coarsely quantised": Circumstances(resolution=(0.004, 0.6)),
    "many outliers": Circumstances(outliers=0.05),
    "interpolated": Circumstances(interpolated=True),
}
QUIET = (
    "correlated noise",
    "irregular",
    "finely quantised",
    "coarsely quantised",
    "outliers",
    "many outliers",
    "wrong branch",
    "extinguished",
)
"""Others are in `test_found`."""

WITH_CAUSE = (
    ("closed loop", "coolant_flow"),
    ("missing rows", "coolant_flow"),
    ("irregular", "coolant_flow"),
    ("coarsely quantised", "coolant_flow"),
    ("narrow", "coolant_flow"),
    pytest.param("many outliers", "coolant_flow", marks=pytest.mark.slow),
    pytest.param("correlated noise", "coolant_flow", marks=pytest.mark.slow),
    pytest.param("process noise", "coolant_flow", marks=pytest.mark.slow),
    pytest.param("wrong branch", "coolant_flow", marks=pytest.mark.slow),
    pytest.param("extinguished", "coolant_temperature", marks=pytest.mark.slow),
)
"""Those marked `slow` take ten seconds together."""


def hidden(case: str, *causes: str) -> Hidden:
    """A record of 150 min, with a step of each cause."""
    effects = tuple(effect for effect in named() if effect.name in causes)
    circumstances = replace(CASES[case], span_min=150.0)
    return draw(
        SEED, effects, circumstances, ("step",) * len(effects), may_leave_branch=circumstances.start != "settled"
    )


def names(said: Diagnosis) -> set[str]:
    return {cause.cause for cause in said.causes} | {name for item in said.alternatives for name, _ in item.causes}


@pytest.mark.parametrize("case", QUIET)
def test_what_is_nominal_stays_nominal(case: str) -> None:
    record = hidden(case)
    said = diagnose(record.record, cstr())
    assert (said.verdict, said.significant, said.causes) == (NOMINAL, False, ())
    noise = np.array([said.gain.held_out[output].noise_sd for output in ("C", "T")])
    rounding = np.array(CASES[case].resolution) / np.sqrt(12.0)
    assert noise == pytest.approx(np.hypot(record.circumstances.noise_sd, rounding), rel=0.12)
    assert any("excluded as outliers" in remark for remark in said.remarks) == ("outliers" in case)


@pytest.mark.parametrize(("case", "cause"), WITH_CAUSE)
def test_a_cause_is_named_with_an_honest_interval_or_is_among_the_rivals(case: str, cause: str) -> None:
    record = hidden(case, cause)
    said = diagnose(record.record, cstr())
    judged = judge(record, said, 0.0)
    assert judged.listed, (said.verdict, said.causes, said.alternatives, said.location)
    for found in said.causes:
        if found.cause == cause and found.profile == "step":
            size = found.parameters["size"]
            assert abs(size.value - record.courses[0].size) < 4.0 * size.sd
    assert judged.held_out < 1.3


def test_an_input_that_went_in_straight_lines_is_a_matter_of_timing_by_half_a_row() -> None:
    said = diagnose(hidden("interpolated").record, cstr())
    (cause,) = said.causes
    assert (cause.cause, cause.profile, said.location) == ("sample_timing", "constant", "timing")
    assert cause.parameters["size"].value == pytest.approx(0.05, abs=0.005)


@pytest.mark.parametrize("case", ["medium", "low noise", "irregular"])
def test_the_onset_of_late_stamps_lies_within_its_interval(case: str) -> None:
    record = hidden(case, "sample_timing")
    said = diagnose(record.record, cstr())
    (cause,) = said.causes
    assert (cause.cause, cause.profile) == ("sample_timing", "step")
    onset = cause.parameters["onset"]
    assert abs(onset.value - record.courses[0].onset_min) < 2.6 * onset.sd  # 99 %
    assert onset.sd < 2.0  # the input moves every minute


def test_a_single_spike_in_the_first_row_or_anywhere_is_no_finding() -> None:
    record = hidden("medium").record
    T, C = record.columns["T"].copy(), record.columns["C"].copy()
    T[0], T[700], C[900] = 650.0, 300.0, 1.9  # without T[0], C[0] is left out as well
    said = diagnose(replace(record, columns=record.columns | {"T": T, "C": C}), cstr())
    assert said.verdict == NOMINAL
    assert said.remarks == ("4 values were excluded as outliers",)


def test_in_a_plant_that_is_out_a_wrong_reaction_is_not_claimed_to_be_something_else() -> None:
    record = replace(CASES["extinguished"], span_min=150.0)
    quiet = draw(SEED, (), record)
    said = diagnose(quiet.record, cstr().with_values({"k0": 1.05 * 7.2e10, "K1": 1.05 * 1.44e13}))
    assert said.verdict == NOMINAL or names(said) & {"reaction_rate", "activation_energy", "reaction_order"}


@pytest.mark.slow
def test_a_bias_of_the_thermometer_is_named_though_a_side_reaction_seems_better_with_the_nominal_noise() -> None:
    """The side reaction, whose energy and heat are fitted, is better by 357 until the noise is estimated again."""
    (bias,) = (effect for effect in named() if effect.name == "temperature_bias")
    record = draw(11_400_006, (bias,), CASES["irregular"])
    said = diagnose(record.record, cstr())
    assert [(cause.cause, cause.profile) for cause in said.causes] == [("temperature_bias", "constant")]
