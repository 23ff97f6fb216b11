"""Unknown inputs are located in records of plants with effects that no catalogue has."""

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.unknown_input.forcing import Forcing
from reactorwatch.diagnosis.unknown_input.localise import UnknownInput, has_feedback, locate
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.noise_estimation import fit_noise
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator

ROWS, PERIOD_MIN, NOISE = 1500, 0.1, np.array([0.002, 0.3])


def effect_of(name: str) -> Effect:
    return next(effect for effect in EFFECTS if effect.name == name)


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
