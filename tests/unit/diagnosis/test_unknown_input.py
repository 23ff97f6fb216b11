"""An unknown input is located, by a filter and smoother that agree with the joint normal distribution."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.unknown_input.forcing import Forcing
from reactorwatch.diagnosis.unknown_input.localise import UnknownInput, has_feedback, locate
from reactorwatch.diagnosis.unknown_input.smoother import PathModel, normalize_columns, smooth
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.noise_estimation import fit_noise
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from tests.unit.process.effect_named import effect_of

STEPS, N_X, N_Y = 7, 2, 2
VARIANCE = 0.7
R = np.array([0.3, 0.5])


class Written(NamedTuple):
    """A linear system and what is seen of it; and the mean and covariance of all states, in a row."""

    linear: PathModel
    kept: Array
    offset: Array
    seen: Array
    mean: Array
    covariance: Array
    of_states: Array


def written(again: int = 0) -> Written:
    """A random one; `again`: a row in which all begins anew."""
    random = np.random.default_rng(3)
    F, G = random.normal(size=(STEPS, N_X, N_X)) * 0.6, random.normal(size=(STEPS, N_X))
    H, D = random.normal(size=(STEPS, N_Y, N_X)), random.normal(size=(STEPS, N_Y))
    q = random.uniform(0.05, 0.2, (STEPS, N_X))
    start, spread = random.normal(size=(STEPS, N_X)), np.tile(np.array([[1.0, 0.3], [0.3, 0.6]]), (STEPS, 1, 1))
    kept = random.uniform(0.4, 0.95, STEPS)
    began = np.zeros(STEPS, dtype=np.bool_)
    began[[0, again]] = True
    used = np.repeat(~began[:, None], N_Y, axis=1)
    used[3, 1] = False
    offset, seen = random.normal(size=(STEPS, N_X, 1)), random.normal(size=(STEPS, N_Y, 1))
    n = N_X + 1
    mean, covariance = np.zeros(STEPS * n), np.zeros((STEPS * n, STEPS * n))
    of_states = np.zeros((STEPS * N_Y, STEPS * n))
    for k in range(STEPS):
        here, before = slice(k * n, (k + 1) * n), slice((k - 1) * n, k * n)
        of_states[k * N_Y : (k + 1) * N_Y, here] = np.column_stack([H[k], D[k]])
        if began[k]:
            mean[here] = [*start[k], 0.0]
            covariance[here, here] = np.block([[spread[k], np.zeros((N_X, 1))], [np.zeros((1, N_X)), VARIANCE]])
            continue
        A = np.block([[F[k], G[k][:, None]], [np.zeros((1, N_X)), kept[k]]])
        mean[here] = A @ mean[before] + [*offset[k, :, 0], 0.0]
        covariance[here] = A @ covariance[before]
        covariance[:, here] = covariance[here].T
        noise = np.diag([*q[k], VARIANCE * (1.0 - kept[k] ** 2)])
        covariance[here, here] = A @ covariance[before, before] @ A.T + noise
    linear = PathModel(F, G, H, D, q, used, began, start, spread)
    return Written(linear, kept, offset, seen, mean, covariance, of_states)


@pytest.mark.parametrize("again", [0, 4])
def test_the_likelihood_is_that_of_the_joint_distribution(again: int) -> None:
    all_of = written(again)
    w, logs = normalize_columns(all_of.linear, R, all_of.kept, VARIANCE, all_of.offset, all_of.seen)
    used = all_of.linear.used.ravel()
    C = all_of.of_states[used]
    reported = multivariate_normal(C @ all_of.mean, C @ all_of.covariance @ C.T + np.diag(np.tile(R, STEPS)[used]))
    found = -0.5 * float(np.sum(w**2)) - logs - 0.5 * np.count_nonzero(used) * np.log(2.0 * np.pi)
    assert found == pytest.approx(float(reported.logpdf(all_of.seen.ravel()[used])), rel=1e-10)


@pytest.mark.parametrize("again", [0, 4])
def test_the_smoothed_states_are_the_means_given_everything_that_is_seen(again: int) -> None:
    all_of = written(again)
    d, m = smooth(all_of.linear, R, all_of.kept, VARIANCE, all_of.offset[:, :, 0], all_of.seen[:, :, 0])
    used = all_of.linear.used.ravel()
    C = all_of.of_states[used]
    S = C @ all_of.covariance @ C.T + np.diag(np.tile(R, STEPS)[used])
    given = all_of.mean + all_of.covariance @ C.T @ np.linalg.solve(S, all_of.seen.ravel()[used] - C @ all_of.mean)
    np.testing.assert_allclose(np.column_stack([d, m]).ravel(), given, atol=1e-10)


def test_a_further_column_is_whitened_as_the_difference_that_it_makes() -> None:
    all_of = written()
    random = np.random.default_rng(4)
    more, shown = random.normal(size=(STEPS, N_X, 1)), random.normal(size=(STEPS, N_Y, 1))
    columns = normalize_columns(
        all_of.linear,
        R,
        all_of.kept,
        VARIANCE,
        np.concatenate([all_of.offset, more], axis=2),
        np.concatenate([all_of.seen, shown], axis=2),
    )[0]
    whole = normalize_columns(
        all_of.linear, R, all_of.kept, VARIANCE, all_of.offset + 2.0 * more, all_of.seen + 2.0 * shown
    )[0]
    np.testing.assert_allclose(columns[:, :, 0] + 2.0 * columns[:, :, 1], whole[:, :, 0], atol=1e-12)


ROWS, PERIOD_MIN, NOISE = 1500, 0.1, np.array([0.002, 0.3])


def make_run(plant: ProcessModel, shown: Callable[[Array], Array] = lambda outputs: outputs) -> Run:
    """Run of a plant whose input steps every minute; `shown` maps the outputs to readings."""
    random = np.random.default_rng(5)
    time_min = PERIOD_MIN * np.arange(ROWS, dtype=np.float64)
    qc = np.repeat(random.uniform(90.0, 111.0, ROWS // 10), 10)[:, None]
    outputs = shown(Simulator(plant).run(time_min, qc, np.array([0.1, 438.54])).outputs)
    return Run(time_min, qc, outputs + random.standard_normal(outputs.shape) * NOISE)


def where(run: Run) -> UnknownInput:
    tuned = fit_noise(cstr(), FilterRecord(run.time_min, run.inputs, run.measured), [1e-4, 1e-2]).levels
    noise = Noise(tuned.measurement_sd, tuned.process_sd)
    nominal = Hypothesis(FaultFilter(cstr(), (), noise), ()).evaluate(run, ())
    found = locate(cstr(), EFFECTS, run, nominal, noise)
    assert found is not None
    return found


def with_rates(of_C: Callable[[ca.SX, ca.SX], ca.SX | float], of_T: Callable[[ca.SX, ca.SX], ca.SX | float]) -> Run:
    """Plant with additional terms in its balances."""
    model = cstr()
    C, T = (state.symbol for state in model.states)
    return make_run(model.add_rate("C", ca.SX(of_C(C, T))).add_rate("T", ca.SX(of_T(C, T))))


def oscillation() -> ca.SX:
    """Now large, now small, at no constant rate."""
    t = cstr().clock.now
    return ca.sin(0.4 * t + 2.0 * ca.sin(0.05 * t)) + 1.0


def test_a_reaction_that_its_own_educt_inhibits() -> None:
    def less(C: ca.SX, T: ca.SX) -> ca.SX:
        return 7.2e10 * ca.exp(-1e4 / T) * C * (1.0 - 1.0 / (1.0 + 0.03 * (C / 0.1) ** 2))

    found = where(with_rates(less, lambda C, T: -200.0 * less(C, T)))
    assert found.effect.location == "reaction"


def test_heat_that_leaves_where_it_is_hot() -> None:
    found = where(with_rates(lambda C, T: 0.0, lambda C, T: -0.6 * ca.fmax(T - 440.0, 0.0)))
    assert found.effect.location == "energy_balance"


def test_dilution_that_comes_and_goes() -> None:
    found = where(with_rates(lambda C, T: -0.05 * oscillation() * C, lambda C, T: 0.0))
    assert found.effect.location == "mass_balance"


def test_a_feed_that_comes_and_goes_and_how_strong_it_was() -> None:
    run = with_rates(lambda C, T: 0.01 * oscillation(), lambda C, T: 0.0)
    found = where(run)
    assert found.effect.name == "feed_concentration"
    truth = 0.01 * (np.sin(0.4 * run.time_min + 2.0 * np.sin(0.05 * run.time_min)) + 1.0)
    assert np.sqrt(np.mean((found.size.sample_value - truth) ** 2)) < 0.25 * np.std(truth)


def test_a_valve_that_is_curved() -> None:
    qc = cstr().inputs[0].symbol
    found = where(make_run(cstr().substitute(qc, qc * (1.0 + 0.02 * ((qc - 100.0) / 10.0) ** 2))))
    assert found.effect.location == "coolant"


@pytest.mark.parametrize(("column", "place"), [(0, "concentration_sensor"), (1, "temperature_sensor")])
def test_a_sensor_that_is_curved(column: int, place: str) -> None:
    def shown(outputs: Array) -> Array:
        bent = outputs.copy()
        middle, spread = outputs[:, column].mean(), outputs[:, column].std()
        bent[:, column] += 2.0 * NOISE[column] * ((outputs[:, column] - middle) / spread) ** 2
        return bent

    assert where(make_run(cstr(), shown)).effect.location == place


def test_a_row_that_is_far_off_does_not_matter() -> None:
    run = with_rates(lambda C, T: 0.0, lambda C, T: -0.6 * ca.fmax(T - 440.0, 0.0))
    measured = run.measured.copy()
    measured[::97, 1] += 20.0
    assert where(replace(run, measured=measured)).effect.location == "energy_balance"


@pytest.mark.parametrize(
    ("name", "sees"),
    [
        ("feed_temperature", ()),
        ("feed_concentration", ()),
        ("reaction_rate", ("C", "T")),
        ("heat_loss", ("T",)),
        ("coolant_temperature", ("qc",)),
        ("coolant_flow", ("T", "qc")),
        ("temperature_bias", ("T",)),
        ("concentration_gain", ("C",)),
    ],
)
def test_a_size_may_depend_on_what_its_own_terms_depend_on(name: str, sees: tuple[str, ...]) -> None:
    model = cstr()
    names = (*model.state_names, *model.input_names)
    assert tuple(names[place] for place in Forcing(model, effect_of(name)).dependencies) == sees


@pytest.mark.parametrize(("gain", "answers"), [(0.0, False), (5.0, True)])
def test_a_controller_s_answer_in_the_same_row_is_noticed(gain: float, answers: bool) -> None:
    """Its input tells of the noise of what it answers, and not of the plant."""
    run = make_run(cstr())
    noise = Noise((0.002, 0.3), (0.0, 0.0))
    answered = Run(run.time_min, run.inputs + gain * (run.measured[:, 1:] - 438.5), run.measured)
    nominal = Hypothesis(FaultFilter(cstr(), (), noise), ()).evaluate(run, ())
    assert has_feedback(answered, nominal) is answers
