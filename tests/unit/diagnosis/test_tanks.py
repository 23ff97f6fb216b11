"""Tanks: faults of the rigs are named, lasting causes go before drifting ones, and rows are held out."""

import json

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.fitting.augmented_model import augment_model
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import FittedProfile, LateSine, PiecewiseLinear, Signal, Sine, Step
from reactorwatch.diagnosis.holdout import evaluate_holdout, holdout_rows
from reactorwatch.diagnosis.lasting import fit_lasting, prefer_lasting
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.report.page import as_page
from reactorwatch.diagnosis.result import NAMED, NOMINAL, UNKNOWN, Diagnosis
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis, Search, SearchResult, smallest_noise
from reactorwatch.process import EFFECTS_OF, effects_of
from reactorwatch.process.effect import Effect
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.library.cascaded_tanks import EFFECTS as TANK_EFFECTS
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record
from reactorwatch.sentences.diagnosis import describe_verdict, diagnosis_text
from tests.unit.diagnosis.rig import LOWER_SPILL_PER_MIN, NOISE_V, Rig, record_of
from tests.unit.diagnosis.runs import make_run as reactor_run
from tests.unit.process.effect_named import effect_of


@pytest.fixture(scope="module")
def overflowing() -> Diagnosis:
    return diagnose(record_of(Rig(overflow_per_min=10.0), seed=2), tanks())


def test_a_rig_that_is_as_simulated_is_nominal() -> None:
    found = diagnose(record_of(Rig(), seed=1), tanks())
    assert (found.verdict, found.causes, found.practical) == (NOMINAL, (), False)
    assert found.gain.held_out["x2"].rmse_after == pytest.approx(NOISE_V, rel=0.15)


def test_the_overflow_that_the_simulation_lacks_is_named_and_gained(overflowing: Diagnosis) -> None:
    found = overflowing
    (cause,) = found.causes
    assert (found.verdict, cause.cause, found.location, found.practical) == (NAMED, "overflow", "upper_tank", True)
    size = cause.parameters["size"]
    assert abs(size.value - 10.0) < 4 * size.sd < 4.0
    gain = found.gain.held_out["x2"]
    assert gain.rmse_before > 5 * NOISE_V
    assert gain.rmse_after < 1.15 * NOISE_V
    extended = parse_extended_model(json.dumps(found.extended_model)).build()
    assert extended.parameter("overflow.size").value == pytest.approx(size.value)


def test_another_brim_and_another_share_that_is_caught_are_fitted() -> None:
    rig = Rig(overflow_per_min=10.0, brim=7.5, caught=0.15)
    found = diagnose(record_of(rig, seed=5), tanks())
    (cause,) = found.causes
    assert (found.verdict, cause.cause) == (NAMED, "overflow")
    for name, truth in (("size", 10.0), ("brim", 7.5), ("caught", 0.15)):
        stated = cause.parameters[name]
        assert abs(stated.value - truth) < 4 * stated.sd < 0.4 * truth, name
    assert found.gain.held_out["x2"].rmse_after < 1.15 * NOISE_V
    extended = parse_extended_model(json.dumps(found.extended_model)).build()
    assert extended.parameter("overflow.brim").value == pytest.approx(cause.parameters["brim"].value)
    assert "brim 7.5" in diagnosis_text(found, effects_of(tanks()))


@pytest.mark.parametrize(
    ("rig", "name", "size"),
    [
        (Rig(pump=0.05, onset_min=22.0), "pump_gain", 0.05),
        (Rig(leak=0.1, onset_min=25.0), "upper_leak", 0.1),
        (Rig(clogging=0.05), "outlet_clogging", 0.05),
        (Rig(bias=-0.1, onset_min=25.0), "level_bias", -0.1),
    ],
)
def test_each_other_cause_is_named(rig: Rig, name: str, size: float) -> None:
    found = diagnose(record_of(rig, seed=3, rows=1000), tanks())
    (cause,) = found.causes
    assert (found.verdict, cause.cause) == (NAMED, name)
    stated = cause.parameters["size"]
    assert abs(stated.value - size) < 4 * stated.sd < 0.2 * abs(size)
    if rig.onset_min:
        assert cause.parameters["onset"].value == pytest.approx(rig.onset_min, abs=0.5)
    gain = found.gain.held_out["x2"]
    assert gain.rmse_after < 1.15 * NOISE_V < gain.rmse_before


def test_its_report_describes_tanks(overflowing: Diagnosis) -> None:
    found = overflowing
    catalogue = effects_of(tanks())
    assert describe_verdict(found).startswith("The simulation is wrong: overflow of the upper tank, ")
    page = as_page(found, tanks(), catalogue, "tanks.csv", "extended.json", on_the_bus=False)
    assert "in the upper tank" in page
    assert "a share of it into the lower tank" in page
    assert '<mrow class="added">' in page
    assert "reactorwatch plant" not in page
    for foreign in ("concentration", "temperature", "coolant", "reactor "):
        assert foreign not in page


def test_the_equations_are_those_of_the_benchmark() -> None:
    """At levels far above the smoothed corner: dx1/dt = k4 u - k1 sqrt(x1), dx2/dt = k2 sqrt(x1) - k3 sqrt(x2)."""
    model = tanks().with_values({"k1": 2.0, "k2": 1.5, "k3": 3.0, "k4": 2.5})
    rates, shown = model.function()([9.0, 4.0], [3.0], model.values(), 0.0, 0.0)
    np.testing.assert_allclose(np.array(rates).ravel(), [2.5 * 3 - 2.0 * 3, 1.5 * 3 - 3.0 * 2], rtol=1e-5)
    assert float(shown) == 4.0


ROWS, ONSET_ROW, NOISE_CM = 1201, 200, 0.15
TIME_MIN: Array = np.arange(ROWS) / 60.0
RAMP = np.maximum(np.arange(ROWS) - ONSET_ROW, 0) / (ROWS - ONSET_ROW)
SINE = (RAMP > 0) * np.sin(2 * np.pi * (TIME_MIN - TIME_MIN[ONSET_ROW]) / 2.0)


def tanks_record(courses: dict[str, Array]) -> Record:
    """Record with deviations in some places; the pumps move as a controller moves them, a little all the time."""
    effects = tuple(effect for effect in EFFECTS_OF["three_tanks"] if effect.name in courses)
    rng = np.random.default_rng(3)
    inputs = np.array([21.4, 53.8]) + 0.1 * np.cumsum(rng.standard_normal((ROWS, 2)), axis=0)
    augmented = augment_model(three_tanks(), effects)
    signals = [Signal(courses[effect.name], courses[effect.name]) for effect in effects]
    values = augmented.inputs(TIME_MIN, inputs, signals)
    levels = Simulator(augmented.model).run(TIME_MIN, values, np.array([41.0, 32.0, 36.6])).outputs
    levels = levels + NOISE_CM * rng.standard_normal(levels.shape)
    columns = dict(zip(("Q1", "Q2", "h1", "h2", "h3"), np.column_stack([inputs, levels]).T, strict=True))
    return Record(TIME_MIN, columns, "tanks")


def found(courses: dict[str, Array], *without: str) -> Diagnosis:
    effects = tuple(effect for effect in EFFECTS_OF["three_tanks"] if effect.name not in without)
    return diagnose(tanks_record(courses), three_tanks(), effects)


@pytest.mark.parametrize(
    ("cause", "size", "without", "places"),
    [
        pytest.param("leak1", 0.1, ("leak1", "pump1"), {"tank1"}, marks=pytest.mark.slow),
        ("clog13", 0.3, ("clog13", "h1.bias"), {"tank1", "tank3"}),
    ],
)
def test_a_growing_fault_is_named_and_without_its_name_unknown_at_its_tank(
    cause: str, size: float, without: tuple[str, ...], places: set[str]
) -> None:
    courses = {cause: size * RAMP}
    known = found(courses)
    assert known.verdict == NAMED
    assert (known.causes[0].cause, known.causes[0].profile) == (cause, "ramp")
    unknown = found(courses, *without)
    assert (unknown.verdict, unknown.causes) == (UNKNOWN, ())
    assert unknown.location in places


def test_sines_that_set_in_later_on_both_pumps_are_one_explanation() -> None:
    stated = found({"pump1": 5.0 * SINE, "pump2": 3.0 * SINE})
    assert {(item.cause, item.profile) for item in stated.causes} == {("pump1", "sine"), ("pump2", "sine")}
    for item, size in zip(sorted(stated.causes, key=lambda each: each.cause), (5.0, 3.0), strict=True):
        assert item.parameters["size"].value == pytest.approx(size, rel=0.1)
        assert item.parameters["onset"].value == pytest.approx(TIME_MIN[ONSET_ROW], abs=0.15)
        assert item.parameters["period"].value == pytest.approx(2.0, rel=0.01)


def test_a_late_sine_continues_the_sine_from_which_it_starts() -> None:
    sine, late = Sine(TIME_MIN), LateSine(TIME_MIN)
    parameters = np.array([0.6, -0.8, 2.3])
    after = TIME_MIN >= 5.0
    expected = np.where(after, sine.signal(parameters).sample_value, 0.0)
    np.testing.assert_allclose(late.signal(late.from_sine(parameters, 5.0)).sample_value, expected, atol=1e-12)


CONSTANTS = ("k1", "k2", "k3", "k4")
OVERFLOW, BIAS, PUMP, LOWER_OUTLET, LOWER_OVERFLOW = (
    next(item for item in TANK_EFFECTS if item.name == name)
    for name in ("overflow", "level_bias", "pump_gain", "lower_outlet", "lower_overflow")
)


def test_a_lasting_cause_is_fitted_together_with_the_uncertain_constants() -> None:
    run = make_run(record_of(Rig(overflow_per_min=10.0, brim=7.5, caught=0.2), seed=5, rows=700), tanks())
    model = tanks().with_values({"k1": 2.5, "k2": 3.6, "k3": 3.5, "k4": 2.6})
    fit = fit_lasting(model, (OVERFLOW,), dict.fromkeys(CONSTANTS, 1.0), run)
    assert fit is not None
    # The scale of the upper level is not observed: flows and products that do not depend on it are.
    assert fit.values["k3"] == pytest.approx(3.0, rel=0.05)
    assert fit.values["k2"] * fit.values["k4"] / fit.values["k1"] == pytest.approx(3.0, rel=0.05)
    assert fit.values["overflow.brim"] / fit.values["k1"] ** -2.0 == pytest.approx(7.5 * 9.0, rel=0.6)
    assert fit.held_out[0] < 1.3 * NOISE_V


def searched(rig: Rig, effect: Effect, profile: type[FittedProfile]) -> tuple[Search, SearchResult]:
    """A search whose best hypothesis is one effect that drifts or steps."""
    run = make_run(record_of(rig, seed=4, rows=700), tanks())
    search = Search(tanks(), (OVERFLOW, BIAS, PUMP), run, smallest_noise(tanks(), run.measured))
    made = PiecewiseLinear(run.time_min, 12) if profile is PiecewiseLinear else Step(run.time_min)
    start = np.zeros(12) if profile is PiecewiseLinear else np.array([0.05, rig.onset_min])
    hypothesis = Hypothesis(search.filter((effect,)), (made,))
    best: FittedHypothesis = search.fit(hypothesis, (start,))
    return search, SearchResult(search.noise, search.noise, search.fit_nominal(), [best])


def test_a_curve_that_does_not_hold_on_other_rows_loses_to_a_lasting_cause_that_does() -> None:
    search, result = searched(Rig(overflow_per_min=10.0, brim=7.5), BIAS, PiecewiseLinear)
    found = prefer_lasting(search, result, result.hypotheses[0], tanks(), {})
    assert found is not None
    best = found.result.hypotheses[0]
    assert best.label == (("overflow", "constant"),)
    assert best.fit.parameters[0][1] == pytest.approx(7.5, rel=0.05)


def test_a_cause_that_did_set_in_later_is_kept() -> None:
    search, result = searched(Rig(pump=0.06, onset_min=22.0), PUMP, Step)
    assert prefer_lasting(search, result, result.hypotheses[0], tanks(), {}) is None


@pytest.mark.slow
def test_terms_that_a_rig_lacks_together_are_named_together() -> None:
    """The upper tank overflows, and the flow of the lower outlet grows faster than the root of the level.

    The verdict of this record is the same with four kernels of the linear algebra. Those of the seeds 7, 9 and 10 are
    "unknown" with one of them: rounding decides which of two near hypotheses is refined.
    """
    record = record_of(Rig(overflow_per_min=10.0, brim=9.0, outlet_power=0.65), seed=11, rows=700)
    found = diagnose(record, tanks(), uncertain=dict.fromkeys(CONSTANTS, 1.5))
    assert {cause.cause for cause in found.causes} == {"overflow", "lower_outlet"}
    (size,) = (cause.parameters["size"].value for cause in found.causes if cause.cause == "lower_outlet")
    assert size == pytest.approx(0.15, abs=0.02)
    assert found.gain.held_out["x2"].rmse_after < 1.15 * NOISE_V


def test_three_lasting_causes_are_fitted_together() -> None:
    rig = Rig(overflow_per_min=10.0, brim=9.0, lower_brim=5.5, outlet_power=0.6)
    run = make_run(record_of(rig, seed=6, rows=700), tanks())
    fit = fit_lasting(tanks(), (OVERFLOW, LOWER_OUTLET, LOWER_OVERFLOW), {}, run)
    assert fit is not None
    for name, truth, share in (
        ("overflow.brim", 9.0, 0.05),
        ("lower_outlet.size", 0.1, 0.05),
        ("lower_overflow.brim", 5.5, 0.01),
        ("lower_overflow.size", LOWER_SPILL_PER_MIN, 0.2),
    ):
        assert fit.values[name] == pytest.approx(truth, rel=share), name
    assert fit.held_out[0] < 1.15 * NOISE_V


SENSORS = Noise((0.002, 0.3), (0.0, 0.0))
COOLANT = effect_of("coolant_flow")


def without_changes(run: Run) -> Run:
    """The run with the rows missing in which its input changed, every tenth time."""
    changed = np.flatnonzero(np.diff(run.inputs[:, 0])) + 1
    there = np.ones(run.time_min.size, dtype=bool)
    there[changed[::10]] = False
    breaks = np.flatnonzero(np.diff(run.time_min[there]) > 0.15) + 1
    return Run(run.time_min[there], run.inputs[there], run.measured[there], tuple(breaks.tolist()))


def test_where_the_time_of_an_input_change_is_unknown_no_model_is_blamed_for_it() -> None:
    run = without_changes(reactor_run("coolant_flow:step:-0.03@100.37min", rows=6000))
    profile, truth = Step(run.time_min), np.array([-0.03, 100.37])
    nominal = Hypothesis(FaultFilter(cstr(), (), SENSORS), ())
    leaking = Hypothesis(FaultFilter(cstr(), (COOLANT,), SENSORS), (profile,))
    before, after = evaluate_holdout(
        run,
        FittedHypothesis(nominal, nominal.evaluate(run, ()), 0.0),
        FittedHypothesis(leaking, leaking.evaluate(run, (truth,)), 0.0),
    )
    assert np.count_nonzero(holdout_rows(run)) > 500
    assert after.simulation / SENSORS.measurement_sd == pytest.approx(1.0, abs=0.09)  # of 500 values, 3 % by chance
    assert before.simulation[1] > 4.0 * after.simulation[1]


def test_where_hardly_a_row_is_free_of_doubt_all_are_judged() -> None:
    time_min = np.linspace(0.0, 99.9, 1000)
    run = Run(time_min, np.zeros((1000, 1)), np.zeros((1000, 2)), tuple(range(20, 1000, 20)))
    assert np.count_nonzero(holdout_rows(run)) == 200
