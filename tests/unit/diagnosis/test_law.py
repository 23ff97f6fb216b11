"""The place and the law of a missing term, with priors on parameters and under feedback too."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from msgspec import structs

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.estimates import covariances_of
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.law.describe import describe_law, law_hypothesis
from reactorwatch.diagnosis.law.fit import select_terms
from reactorwatch.diagnosis.law.formula import round_reference
from reactorwatch.diagnosis.law.shapes import find_answers, make_shape
from reactorwatch.diagnosis.law.unknown import Unknown, find_laws, fit_places, start_places
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.result import SD_95, UNKNOWN, Law
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.law import find_form, find_place
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.cstr_operation import BOILING_FROM_K, BOILING_RATE, EXAMPLES
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record
from tests.hidden_effect.catalogue import named
from tests.hidden_effect.draw import Hidden, draw
from tests.hidden_effect.excitation import MEDIUM_NOISE, Circumstances

ROWS, PERIOD_MIN = 1500, 0.1
NOISE = {"cstr": (0.002, 0.3), "three_tanks": (0.05, 0.05, 0.05)}


def reactor(kind: str) -> ProcessModel:
    """The reactor with a term that it lacks."""
    model = cstr()
    C, T = (state.symbol for state in model.states)
    rate = 7.2e10 * ca.exp(-1e4 / T) * C
    if kind == "heat capacity":
        slower = ca.SX(1) / (1 + 0.01 * (T - 440.0))
        return replace(model, rhs=(model.rhs[0], model.rhs[1] * slower))
    rates = {
        "evaporation": (ca.SX(0), -0.6 * ca.fmax(T - 441.0, 0.0)),
        "inhibition": (0.03 * rate * C / 0.1, -6.0 * rate * C / 0.1),
        "loss of A": (-0.02 * ca.exp(0.06 * (T - 440.0)) * C / 0.1, ca.SX(0)),
    }
    of_C, of_T = rates[kind]
    return model.add_rate("C", of_C).add_rate("T", of_T)


def bypass_of_pipe() -> ProcessModel:
    """Three tanks with a second, laminar pipe from tank 1 to tank 3."""
    model = three_tanks()
    h1, _, h3 = (state.symbol for state in model.states)
    flow = 60.0 / 154.0 * 0.06 * (h1 - h3)
    return model.add_rate("h1", -flow).add_rate("h3", flow)


@cache
def found(kind: str) -> tuple[ProcessModel, Run, Unknown]:
    plant, model = (bypass_of_pipe(), three_tanks()) if kind == "laminar pipe" else (reactor(kind), cstr())
    random = np.random.default_rng(7)
    time_min = PERIOD_MIN * np.arange(ROWS, dtype=np.float64)
    low, high, hold = (90.0, 111.0, 10) if model.name == "cstr" else (15.0, 45.0, 30)
    inputs = np.repeat(random.uniform(low, high, (ROWS // hold + 1, len(model.inputs))), hold, axis=0)[:ROWS]
    start = np.array([0.1, 438.54] if model.name == "cstr" else [40.0, 20.0, 30.0])
    outputs = Simulator(plant).run(time_min, inputs, start).outputs
    sd: Array = np.array(NOISE[model.name])
    run = Run(time_min, inputs, outputs + sd * random.standard_normal(outputs.shape))
    noise = Noise(tuple(sd.tolist()), tuple(0.02 * state.scale for state in model.states))
    nominal = Hypothesis(FaultFilter(model, (), noise), ()).evaluate(run, ())
    started = start_places(model, run, nominal, noise)
    return model, run, find_laws(model, run, fit_places(model, run, started))


@pytest.mark.parametrize(
    ("kind", "location", "forms"),
    [
        ("evaporation", "energy_balance", {"threshold"}),
        ("heat capacity", "energy_balance", {"linear", "difference"}),
        ("inhibition", "reaction", {"linear", "power", "difference"}),
        ("loss of A", "mass_balance", {"product", "exponential"}),
        ("laminar pipe", "pipe13", {"power", "linear", "difference"}),
    ],
)
def test_the_place_and_the_form_are_found(kind: str, location: str, forms: set[str]) -> None:
    _, _, unknown = found(kind)
    assert next(iter(unknown.locations)) == location
    assert find_form(unknown.laws[0].law.form).form in forms


def test_the_law_has_the_constants_of_the_plant_within_their_intervals() -> None:
    law = described("evaporation")
    for name, value in {"b": -0.6, "c": 441.0}.items():
        assert abs(law.parameters[name].value - value) < 2.0 * SD_95 * law.parameters[name].sd
    assert law.parameters["b"].sd < 0.05
    assert (law.parameters["b"].unit, law.parameters["c"].unit) == ("K/min/K", "K")
    assert law.range["T"][0] < 441.0 < law.range["T"][1]


def test_a_constant_of_a_law_that_another_parameter_could_imitate_is_marked() -> None:
    assert described("loss of A").correlations["a"].parameter in {"k0", "q", "V", "Cf", "E_R"}


def test_rivals_are_listed_up_to_ten_bic() -> None:
    law = described("heat capacity")
    assert all(0.0 <= rival.delta_bic < 10.0 for rival in law.rivals)
    assert {"linear", "difference"} <= {law.form, *(rival.form for rival in law.rivals)}


def test_the_curves_of_smooth_correction_and_formula_agree() -> None:
    (curve,) = described("evaporation").curves
    assert np.sqrt(np.mean((curve.smooth - curve.formula) ** 2)) < 0.1 * np.ptp(curve.formula)


def described(kind: str) -> Law:
    model, run, unknown = found(kind)
    law, hypothesis = law_hypothesis(unknown.laws[0], run, model, {})
    return describe_law(model, run, unknown, law, covariances_of(run, hypothesis), {})


def test_only_functions_that_are_worth_their_charge_are_selected() -> None:
    random = np.random.default_rng(1)
    g = random.standard_normal((500, 6))
    truth = np.array([0.0, 2.0, 0.0, 0.0, -1.0, 0.0])
    w = g @ truth + random.standard_normal(500)
    assert select_terms(g.T @ g, g.T @ w, float(np.log(500.0))) == [1, 4]


@pytest.mark.parametrize(("mean", "spread", "expected"), [(438.54, 4.2, 440.0), (0.0936, 0.012, 0.09), (1e4, 0.0, 1e4)])
def test_a_reference_is_a_round_number_near_the_mean(mean: float, spread: float, expected: float) -> None:
    assert round_reference(mean, spread) == pytest.approx(expected)


LEVELS = Noise(MEDIUM_NOISE, (0.002, 0.2))


def drifting(cause: str, loop: str, seed: int, span_min: float = 150.0) -> Hidden:
    """A record in which a cause drifts."""
    (effect,) = (item for item in named() if item.name == cause)
    return draw(seed, (effect,), Circumstances(input=loop, span_min=span_min), kinds=("free",))


@pytest.mark.parametrize("cause", ["heat_transfer", "concentration_bias", "temperature_lag"])
@pytest.mark.parametrize("loop", ["rich", "narrow", "few", "closed"])
def test_the_coolant_answers_to_the_thermometer_in_closed_loop_alone(cause: str, loop: str) -> None:
    model = cstr()
    run = make_run(drifting(cause, loop, seed=3).record, model)
    answers = find_answers(model, run)
    assert answers == ({("T", "qc")} if loop == "closed" else set())


def test_the_error_of_a_sensor_does_not_depend_on_an_input_that_answers_to_it() -> None:
    model = cstr()
    run = make_run(drifting("heat_transfer", "closed", seed=3).record, model)
    nominal = Hypothesis(FaultFilter(model, (), LEVELS), ()).evaluate(run, ())
    scales, place = start_places(model, run, nominal, LEVELS).scales, find_place(model, "thermometer")
    x, moved = np.full((2, 2), [0.1, 438.5]), np.array([[100.0], [109.0]])
    for known, is_constant in ((frozenset[tuple[str, str]](), False), (frozenset({("T", "qc")}), True)):
        shape = make_shape(model, place, scales, known)
        first, second = shape.basis(x, moved)
        assert np.array_equal(first, second) is is_constant


@pytest.mark.slow
@pytest.mark.parametrize(("cause", "seed"), [("heat_transfer", 10300020), ("heat_transfer", 10300022)])
def test_a_drift_in_closed_loop_is_named_and_no_unknown_error_of_the_thermometer(cause: str, seed: int) -> None:
    """An error that follows the coolant was better by thousands in BIC than the cause."""
    result = diagnose(drifting(cause, "closed", seed, span_min=300.0).record, cstr())
    assert (result.verdict, [item.cause for item in result.causes]) == ("named", [cause])


BOILING_ROWS, STEP_MIN, NOISE_SD = 500, 0.1, (0.002, 0.3)


def boiling_reactor() -> Record:
    """Record of the reactor whose contents boil, from the nominal parameters."""
    random, build = np.random.default_rng(3), EXAMPLES["unknown"].with_law
    assert build is not None
    time_min = STEP_MIN * np.arange(BOILING_ROWS, dtype=np.float64)
    inputs = np.repeat(random.uniform(90.0, 111.0, (BOILING_ROWS // 10, 1)), 10, axis=0)
    outputs = Simulator(build(cstr())).run(time_min, inputs, np.array([0.1, 438.54])).outputs
    C, T = (outputs + np.array(NOISE_SD) * random.standard_normal(outputs.shape)).T
    return Record(time_min, {"qc": inputs[:, 0], "C": C, "T": T}, "boiling")


@pytest.mark.parametrize(
    ("stated", "sds"),
    [
        pytest.param({"K3": 714.0}, {"K3": 14.0}, id="stated 2 % too high"),
        pytest.param({"q": 100.0}, {"q": 0.02}, id="a flow", marks=pytest.mark.slow),
        pytest.param({"Tf": 350.0, "Tcf": 350.0}, {"Tf": 0.02, "Tcf": 0.02}, id="temperatures", marks=pytest.mark.slow),
    ],
)
def test_the_law_and_the_uncertain_parameters_are_within_their_intervals(
    stated: Mapping[str, float], sds: Mapping[str, float]
) -> None:
    truth, model = cstr(), cstr().with_values(stated)
    result = diagnose(boiling_reactor(), model, uncertain=sds)
    assert result.verdict == UNKNOWN
    assert result.law is not None
    assert set(result.parameters) == set(sds)
    for name, item in result.parameters.items():
        assert item.nominal == stated[name]
        assert item.estimate.sd <= 1.001 * sds[name]
        assert abs(item.estimate.value - truth.parameter(name).value) < 4.0 * item.estimate.sd
    assert result.law.parameters["b"].value == pytest.approx(-BOILING_RATE, abs=4.0 * result.law.parameters["b"].sd)
    assert result.law.parameters["c"].value == pytest.approx(BOILING_FROM_K, abs=4.0 * result.law.parameters["c"].sd)
    held = result.law.extended.parameters
    assert all(item == structs.replace(item, value=held[name]) for name, item in result.law.parameters.items())
