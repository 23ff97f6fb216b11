"""The place and the law of a missing term are found in records of plants with terms that no catalogue has."""

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.estimates import covariances_of
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.law.describe import describe_law, law_hypothesis
from reactorwatch.diagnosis.law.fit import select_terms
from reactorwatch.diagnosis.law.formula import round_reference
from reactorwatch.diagnosis.law.unknown import Unknown, find_laws, fit_places, start_places
from reactorwatch.diagnosis.result import SD_95, Law
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.law import find_form
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator

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
