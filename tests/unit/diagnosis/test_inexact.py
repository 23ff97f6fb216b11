"""Explanations with nuisance: derivatives, evidence, and two heaters that are not quite their model."""

from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import multivariate_normal

from benchmarks.inexact import two_heaters
from benchmarks.inexact.records import Drawn, write_files
from reactorwatch.api.diagnosis import diagnose
from reactorwatch.api.records import read_record
from reactorwatch.diagnosis.diagnose import diagnose as find_causes
from reactorwatch.diagnosis.fitting.descent import Equations, descend
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.inexact.answer import relative_delays
from reactorwatch.diagnosis.inexact.explain import Explained, Explanation, explain
from reactorwatch.diagnosis.inexact.fit import Fitter
from reactorwatch.diagnosis.inexact.hypotheses import CONSTANT, NONE, STEP, WIDTH, Courses, Hypothesis
from reactorwatch.diagnosis.inexact.noise import estimate_discrepancy, white
from reactorwatch.diagnosis.inexact.nuisance import Nuisance, Prior
from reactorwatch.diagnosis.inexact.screen import Screen
from reactorwatch.diagnosis.inexact.simulation import InexactSimulation, ProductForcing
from reactorwatch.diagnosis.run import Run
from reactorwatch.process import effects_of
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.model import ProcessModel
from tests.two_tanks import record_of_two_tanks, two_tanks

ROWS, PERIOD_MIN = 240, 0.1
TIME = np.asarray(PERIOD_MIN * np.arange(ROWS), dtype=float)


@lru_cache(maxsize=1)
def plant() -> tuple[ProcessModel, Run, Nuisance]:
    """Two tanks whose inflow steps every 4 min."""
    model = tanks()
    rng = np.random.default_rng(3)
    levels = [rng.uniform(0.8, 1.2, size=6) * item.usual for item in model.inputs if item.usual is not None]
    inputs = np.column_stack([np.repeat(item, ROWS // 6) for item in levels])
    start = np.array([0.5 * (item.lower + item.upper) for item in model.states])
    run = Run(TIME, inputs, np.zeros((ROWS, len(model.outputs))))
    simulation = InexactSimulation(model, effects_of(model), run, start)
    return model, run, Nuisance(simulation, start[None], {})


def test_the_simulation_is_that_of_an_independent_solver() -> None:
    model, run, nuisance = plant()
    simulated = nuisance.simulate(np.zeros(nuisance.size))
    assert simulated is not None
    rates, x = model.function("rhs"), simulated.x[0]
    for row in range(40):
        u = run.inputs[row]

        def slope(t: float, x: np.ndarray, u: np.ndarray = u) -> np.ndarray:
            return np.array(rates(x, u, model.values(), t, t)[0]).ravel()

        found = solve_ivp(slope, (TIME[row], TIME[row + 1]), x, rtol=1e-9, atol=1e-11)
        x = found.y[:, -1]
        assert simulated.x[row + 1] == pytest.approx(x, rel=1e-4)


@pytest.mark.parametrize("late", [0.0, 0.07], ids=["sensors at once", "slow sensors"])
def test_the_derivatives_by_all_nuisance_are_differences_of_simulations(late: float) -> None:
    _, _, nuisance = plant()
    theta = np.zeros(nuisance.size)
    theta[nuisance.output_lags] = late
    simulated = nuisance.simulate(theta)
    assert simulated is not None
    found = nuisance.linearise(theta, simulated)
    sizes = np.maximum(np.max(np.abs(found.derivatives), axis=(0, 1)), 1e-9)
    for index in range(nuisance.moves.start):
        step = 1e-4 * nuisance.sds(Prior(1.0, 1.0, False))[index]
        moved = theta.copy()
        moved[index] += step
        other = nuisance.simulate(moved)
        assert other is not None
        difference = (nuisance.read(other, moved) - found.read) / step
        # an input that is held has a kink at each move, so the derivative by its delay is that of one side
        assert np.max(np.abs(difference - found.derivatives[:, :, index])) < 0.1 * sizes[index], nuisance.names[index]


def test_the_derivatives_by_a_step_of_every_effect_are_differences_of_simulations() -> None:
    _, _, nuisance = plant()
    theta, simulation = np.zeros(nuisance.size), nuisance.simulation
    simulated = nuisance.simulate(theta)
    assert simulated is not None
    found = nuisance.linearise(theta, simulated)
    course = Courses(TIME, PERIOD_MIN).course(STEP, 7.03)
    forcing = ProductForcing(Signal(course.interval_mean[:, None], course.sample_value[:, None]))
    starts = np.zeros((1, simulated.x.shape[1], simulation.typical.size))
    derivatives = nuisance.derivatives(theta, found.slopes, starts, forcing)
    for index, typical in enumerate(simulation.typical.tolist()):
        sizes = np.where(np.arange(simulation.typical.size) == index, 1e-4 * typical, 0.0)
        other = nuisance.simulate(
            theta, Signal(np.outer(course.interval_mean, sizes), np.outer(course.sample_value, sizes))
        )
        assert other is not None
        difference = (nuisance.read(other, theta) - found.read) / (1e-4 * typical)
        assert difference == pytest.approx(
            derivatives[:, :, index], abs=0.01 * np.max(np.abs(derivatives[:, :, index]))
        )
        assert not np.any(difference[TIME < 7.0])


def test_a_lag_is_the_closed_form_of_a_first_order_lag() -> None:
    _, _, nuisance = plant()
    ramp = np.column_stack([TIME, 2.0 * TIME])
    lagged = nuisance.simulation.read(ramp, np.zeros(2), np.array([0.5, 0.0]), PERIOD_MIN)
    assert lagged[:, 0] == pytest.approx(TIME - 0.5 * (1.0 - np.exp(-TIME / 0.5)))
    assert lagged[:, 1] == pytest.approx(2.0 * TIME)


def test_a_discrepancy_is_estimated_and_whitened() -> None:
    rng = np.random.default_rng(1)
    e = rng.standard_normal((4000, 2))
    r = np.zeros_like(e)
    for row in range(1, len(e)):  # (1 - 0.95 L) r = (1 - 0.6 L) e, in the first column
        r[row] = 0.95 * r[row - 1] + e[row] - 0.6 * e[row - 1]
    r[:, 1] = e[:, 1]
    found = estimate_discrepancy(r, np.full(2, 1e-6))
    assert (found.a[0], found.b[0]) == pytest.approx((0.95, 0.6), abs=0.06)
    assert (found.a[1], found.b[1]) == (0.0, 0.0)
    assert found.sd == pytest.approx(np.ones(2), rel=0.05)
    assert np.std(found.whiten(r), axis=0) == pytest.approx(np.ones(2), rel=0.05)


def test_the_evidence_of_the_screen_is_that_of_a_normal_distribution() -> None:
    _, _, nuisance = plant()
    rng = np.random.default_rng(2)
    values, courses = 60, Courses(TIME, PERIOD_MIN)
    theta, residual = np.zeros(nuisance.size), rng.standard_normal(values)
    base = rng.standard_normal((values, nuisance.size))
    effects = nuisance.simulation.typical.size
    causes = rng.standard_normal((values, effects, courses.onsets.size + courses.knots.size))
    index = nuisance.effects.start
    screen = Screen(nuisance, courses, {index: WIDTH}, theta, residual, base, causes)
    by_cause = {(item.prior, *item.cause): item for item in screen.rank()}
    prior = nuisance.priors[0]
    sds = nuisance.sds(prior)
    offset = by_cause[prior, "none", -1].log_evidence - log_normal(residual, base, sds)
    wider = sds.copy()
    wider[index] = WIDTH
    assert by_cause[prior, CONSTANT, index].log_evidence == pytest.approx(log_normal(residual, base, wider) + offset)
    width = WIDTH * nuisance.simulation.typical[1]
    each = [
        log_normal(residual, np.column_stack([base, causes[:, 1, number]]), np.append(sds, width))
        for number in range(courses.onsets.size)
    ]
    mean = np.logaddexp.reduce(each) - np.log(len(each))
    assert by_cause[prior, STEP, 1].log_evidence == pytest.approx(mean + offset)


def log_normal(residual: np.ndarray, columns: np.ndarray, sds: np.ndarray) -> float:
    """Log density of a residual of unit noise and normal coefficients of columns."""
    covariance = np.eye(residual.size) + (columns * sds**2) @ columns.T
    return float(multivariate_normal(np.zeros(residual.size), covariance).logpdf(residual))


@pytest.mark.parametrize("direction", [1.0, -1.0], ids=["input late", "input early"])
def test_a_delay_between_input_and_output_is_stated_where_only_their_sum_is_known(direction: float) -> None:
    """The record gives the sum of both delays with a standard deviation m, and each is 0 +- s beforehand."""
    _, _, nuisance = plant()
    prior = Prior(0.1, 1.0, moves=False)
    sds, delays = nuisance.sds(prior), [nuisance.input_delays.start, nuisance.output_delays.start]
    s, m = sds[delays[0]], 0.1 * sds[delays[0]]
    information = np.diag(sds**-2.0)
    information[np.ix_(delays, delays)] += m**-2.0
    theta = np.zeros(nuisance.size)
    theta[delays] = direction * 0.4 * s
    fitted = SimpleNamespace(hypothesis=SimpleNamespace(prior=prior), theta=theta, information=information)
    fitted.theta_sd = np.sqrt(np.diag(np.linalg.inv(information)))
    explained = cast(Explained, SimpleNamespace(nuisance=nuisance))
    (found,) = relative_delays(cast(Explanation, SimpleNamespace(fitted=fitted)), explained)
    assert found.name == f"{nuisance.simulation.model.input_names[0]}.delay"
    assert found.value.value == pytest.approx(direction * 0.8 * s)
    assert found.value.sd == pytest.approx((m**-2.0 + 0.5 * s**-2.0) ** -0.5)
    assert found.prior_sd == pytest.approx(np.sqrt(2.0) * s)
    fitted.theta = theta / 10.0
    assert not relative_delays(cast(Explanation, SimpleNamespace(fitted=fitted)), explained)


def test_a_stated_sd_is_the_prior_of_its_parameter_and_none_is_exact() -> None:
    model, _, nuisance = plant()
    effect = next(item for item in nuisance.simulation.effects if getattr(item, "parameter", "") and item.unit == "1")
    index = nuisance.names.index(effect.name)
    value = model.parameter(effect.parameter).value  # type: ignore[attr-defined]
    start = nuisance.simulate(np.zeros(nuisance.size))
    assert start is not None
    for stated, expected in ((0.05 * value, 0.05), (0.0, 1e-3 * abs(effect.typical))):
        other = Nuisance(nuisance.simulation, start.x[:1], {effect.parameter: stated})  # type: ignore[attr-defined]
        assert other.sds(Prior(1.0, 1.0, False))[index] == pytest.approx(expected)


@pytest.mark.parametrize("known", [np.nan, np.inf, None])
def test_a_descent_ends_where_its_equations_cannot_be_solved(known: float | None) -> None:
    start = SimpleNamespace(loss=1.0)

    def equations(point: SimpleNamespace) -> Equations | None:
        return None if known is None else (np.array([[known, 0.0], [0.0, 1.0]]), np.ones(2))

    assert descend(start, equations, lambda point, step: None, 5) is start


def test_a_simulation_that_has_left_the_record_is_no_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """An unstable plant may end in numbers whose squares are none."""
    _, run, nuisance = plant()
    step = nuisance.simulation._step_after_step
    monkeypatch.setattr(
        step, "map", lambda *given: [1e200 * (1.0 + np.abs(item)) for item in type(step).map(step, *given)]
    )
    measured, theta = run.measured[nuisance.simulation.rows], np.zeros(nuisance.size)
    fitter = Fitter(nuisance, Courses(TIME, PERIOD_MIN), {}, measured)
    assert fitter.fit(Hypothesis(NONE, -1, nuisance.priors[0]), theta, white(np.ones(measured.shape[1]))) is None


def test_without_effects_there_is_no_explanation() -> None:
    model, run, _ = plant()
    start = np.array([[0.5 * (item.lower + item.upper) for item in model.states]])
    assert explain(model, (), run, start, {}, [1e-3] * len(model.outputs)) is None


def drawn_as(group: str, *, sound: bool = False) -> Drawn:
    """The first record of a class."""
    return next(item for number in range(40) if (item := two_heaters.draw(7, number, sound)).group == group)


@pytest.mark.parametrize(
    "group",
    [
        "skew",
        *(pytest.param(item, marks=pytest.mark.slow) for item in ("moves", "lag", "constants", "capacity", "pairs")),
    ],
)
def test_a_cause_is_named_in_a_record_that_is_not_quite_the_model(group: str, tmp_path: Path) -> None:
    drawn = drawn_as(group)
    assert drawn.cause is not None
    path, process = write_files(drawn, tmp_path)
    found = diagnose(read_record(path, process=process))
    assert found.grade in ("explained", "mostly")
    (cause,) = found.causes
    assert cause.cause in drawn.cause.names
    sizes = [abs(cause.parameters["size"].value / size - 1.0) for size in drawn.cause.sizes]
    assert min(sizes) < 0.05
    assert drawn.cause.onset_min is not None
    assert cause.parameters["onset"].value == pytest.approx(drawn.cause.onset_min, abs=0.2)
    assert cause.share > 0.95
    assert found.nearest[0].cause == cause.cause
    assert found.onset == cause.parameters["onset"]
    assert any(remark.startswith("read as") for remark in found.result.remarks)


@pytest.mark.slow
@pytest.mark.parametrize("output", ["T1", "T2"])
def test_the_onset_of_a_sensors_error_is_not_known_better_than_to_a_row(output: str, tmp_path: Path) -> None:
    records = (two_heaters.draw(7, number, False) for number in range(40))
    drawn = next(item for item in records if item.cause is not None and f"{output}.bias" in item.cause.names)
    assert drawn.cause is not None
    path, process = write_files(drawn, tmp_path)
    onset = diagnose(read_record(path, process=process)).causes[0].parameters["onset"]
    assert onset.sd >= drawn.period_min / 12.0**0.5
    assert onset.value == pytest.approx(drawn.cause.onset_min, abs=4.0 * onset.sd)


@pytest.mark.parametrize(
    ("seed", "onset", "bias"), [(1, 447, -0.25), pytest.param(2, 418, 0.25, marks=pytest.mark.slow)]
)
def test_a_step_of_a_sensor_is_named_at_any_row_where_inputs_wander_unseen(seed: int, onset: int, bias: float) -> None:
    record = record_of_two_tanks(seed)
    record.columns["h2"][onset:] += bias
    found = find_causes(record, two_tanks())
    (cause,) = found.causes
    assert cause.cause == "h2.bias"
    assert cause.parameters["size"].value == pytest.approx(bias, abs=0.03)
    assert cause.parameters["onset"].value == pytest.approx(onset * PERIOD_MIN, abs=PERIOD_MIN)


@pytest.mark.slow
@pytest.mark.parametrize("group", ["skew", "lag", "constants"])
def test_a_sound_plant_that_is_not_quite_its_model_is_called_right(group: str, tmp_path: Path) -> None:
    path, process = write_files(drawn_as(group, sound=True), tmp_path)
    found = diagnose(read_record(path, process=process))
    assert (found.verdict, found.grade, found.causes) == ("nominal", "right", ())
    assert not found.practical
