"""Parameters that are known to a stated standard deviation: what is within it is no finding, and is allowed for."""

import json
from dataclasses import replace

import numpy as np
import pytest

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.parameter_priors import add_priors, offsets, parse_priors
from reactorwatch.diagnosis.result import NAMED, NOMINAL
from reactorwatch.diagnosis.run import Run
from reactorwatch.errors import InputError
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.ekf import Filter
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.library.cstr import cstr
from tests.unit.diagnosis.linear_tank import Gain, Shift, tank, tank_record
from tests.unit.diagnosis.runs import make_run, record_of

SENSORS = Noise((0.002, 0.3), (0.0, 0.0))
WARMER = "feed_temperature:constant:0.5"


def estimate_offset(run: Run, sds: dict[str, float]) -> tuple[float, float]:
    """Offset of the feed's temperature in the end, and its standard deviation."""
    noise = Noise(SENSORS.measurement_sd, (0.0,) * (2 + len(sds)))
    _, _, found = FaultFilter(add_priors(cstr(), sds), (), noise).evaluate(run, ())
    return float(found.x[-1, 2]), float(np.sqrt(found.P[-1, 2, 2]))


def test_the_likelihood_is_that_of_all_offsets_weighed_by_what_was_stated() -> None:
    run, sd = make_run(WARMER, rows=400), 0.5
    noise = Noise(SENSORS.measurement_sd, (0.0, 0.0, 0.0))
    uncertain = Filter(add_priors(cstr(), {"Tf": sd}), noise).run(FilterRecord(run.time_min, run.inputs, run.measured))
    grid = np.linspace(0.0, 1.0, 101)
    given = []
    for offset in grid:
        known = Filter(cstr().with_values({"Tf": 350.0 + offset}), SENSORS)
        given.append(float(np.sum(known.run(FilterRecord(run.time_min, run.inputs, run.measured)).log_likelihood)))
    weighed = np.array(given) - 0.5 * (grid / sd) ** 2 - np.log(np.sqrt(2.0 * np.pi) * sd)
    marginal = weighed.max() + np.log(np.sum(np.exp(weighed - weighed.max())) * (grid[1] - grid[0]))
    assert float(np.sum(uncertain.log_likelihood)) == pytest.approx(marginal, abs=0.5)
    assert float(uncertain.x[-1, 2]) == pytest.approx(
        float(np.average(grid, weights=np.exp(weighed - weighed.max()))), abs=0.01
    )


def test_what_was_learned_of_a_parameter_outlasts_a_break_in_the_record() -> None:
    run = make_run(WARMER, rows=1000)
    whole, broken = estimate_offset(run, {"Tf": 0.5}), estimate_offset(replace(run, breaks=(500, 980)), {"Tf": 0.5})
    assert whole[0] == pytest.approx(0.5, abs=4 * whole[1])
    assert broken[0] == pytest.approx(whole[0], abs=2 * whole[1])
    assert broken[1] < 1.2 * whole[1]


def test_a_parameter_off_by_as_much_as_stated_is_no_finding_and_without_the_statement_it_is() -> None:
    record = record_of(WARMER, rows=1500)
    exact, rough = diagnose(record, cstr()), diagnose(record, cstr(), uncertain={"Tf": 0.5})
    assert exact.verdict != NOMINAL
    assert (rough.verdict, rough.significant, rough.practical, rough.causes) == (NOMINAL, False, False, ())
    said = rough.parameters["Tf"]
    assert said.differs
    assert abs(said.estimate.value - 350.5) < 4 * said.estimate.sd
    assert said.estimate.sd < 0.2 * said.stated_sd
    assert rough.gain.held_out["T"].rmse_before < 1.1 * 0.3
    adjusted = parse_extended_model(json.dumps(rough.extended_model)).build()
    assert diagnose(record, adjusted).verdict == NOMINAL


@pytest.mark.slow
def test_a_cause_is_found_beside_parameters_that_are_off_and_its_interval_is_wider() -> None:
    record = record_of("heat_transfer:constant:0.02", "coolant_temperature:constant:1.5", rows=1500)
    exact, rough = (diagnose(record, cstr(), uncertain=item) for item in ({}, {"K3": 14.0, "Tf": 0.5}))
    (cause,) = rough.causes
    size = cause.parameters["size"]
    assert (rough.verdict, cause.cause, cause.profile) == (NAMED, "coolant_temperature", "constant")
    assert abs(size.value - 1.5) < 4 * size.sd
    assert size.sd > 1.5 * exact.causes[0].parameters["size"].sd


@pytest.mark.parametrize(("size", "named"), [(-0.03, False), (-0.3, True)])
def test_the_uncertain_parameter_itself_is_a_cause_only_if_it_is_far_from_what_was_stated(
    size: float, named: bool
) -> None:
    found = diagnose(record_of(f"heat_transfer:constant:{size}", rows=1500), cstr(), uncertain={"K3": 14.0})
    causes = {cause.cause for cause in found.causes} | {name for item in found.alternatives for name, _ in item.causes}
    assert ("heat_transfer" in causes) == named
    assert found.practical == named
    if named:
        said = found.causes[0].parameters["size"]
        assert said.value == pytest.approx(size, abs=0.06)
        assert said.sd > 0.015  # it is known no better than the parameter that it multiplies, 2 %


def test_no_parameter_costs_the_filter_a_state_unless_it_is_uncertain() -> None:
    assert add_priors(cstr(), {}) is cstr()
    assert add_priors(cstr(), {"K3": 0.0}) is cstr()
    assert offsets(add_priors(cstr(), {"V": 1.0, "q": 2.0}), np.array([0.1, 440.0, 3.0, 4.0])) == {
        "V": 3.0,
        "q": 4.0,
    }


def test_tolerances_are_shares_or_numbers_with_the_unit_of_the_parameter() -> None:
    priors = parse_priors("K3=2%, Tf = 0.5K,V=1.5e0 l,q=0,Cf=0%", cstr())
    assert priors == pytest.approx({"K3": 14.0, "Tf": 0.5, "V": 1.5, "q": 0.0, "Cf": 0.0})


def test_a_share_of_a_temperature_in_celsius_is_refused() -> None:
    room = replace(cstr().parameter("Tf"), unit="degC", value=21.0, lower=0.0, upper=50.0)
    model = replace(cstr(), parameters=tuple(room if item.name == "Tf" else item for item in cstr().parameters))
    assert parse_priors("Tf=0.5 degC", model) == {"Tf": 0.5}
    with pytest.raises(InputError, match="must be in degC, of which a share is no size, got '2%'"):
        parse_priors("Tf=2%", model)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("K9=2%", "must be of q, V, Cf, .*, got K9"),
        ("K3", "parameter=tolerance, such as K3=2%,Tf=0.5K, got 'K3'"),
        ("K3=2", "in % or in l/min, got '2'"),
        ("Tf=0.5C", "in % or in K, got '0.5C'"),
        ("Tf=-1K", "parameter=tolerance"),
        ("Tf=351K", "at most its value, 350 K, got 351; state its standard deviation, or correct its value"),
        ("K3=101%", "at most its value, 700 l/min, got 707"),
        ("Tf=1.2.3K", "must be a number with % or K"),
        ("", "parameter=tolerance"),
    ],
)
def test_an_impossible_prior_is_refused_in_one_line(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse_priors(text, cstr())


@pytest.mark.parametrize(
    ("uncertain", "said"),
    [({"p": 1.0}, "got p"), ({"K3": -1.0}, "not negative"), ({"K3": np.nan}, "not negative"), ({"V": 1e3}, "at most")],
)
def test_a_standard_deviation_is_of_a_parameter_and_neither_negative_nor_above_its_value(
    uncertain: dict[str, float], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        diagnose(record_of(rows=400), cstr(), uncertain=uncertain)


def test_a_parameter_stated_to_be_exact_is_none_of_the_uncertain_ones() -> None:
    found, exact = (
        diagnose(tank_record(gain=1.1), tank(), (Gain(), Shift()), uncertain=uncertain)
        for uncertain in ({}, {"gain": 0.0})
    )
    assert exact.to_dict() == found.to_dict()
