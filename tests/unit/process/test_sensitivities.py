"""Sensitivities of a free run equal central differences of it, for every effect and profile, onsets included."""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr.effects import EFFECTS
from reactorwatch.process.library.cstr.effects.coolant_flow import CoolantFlow
from reactorwatch.process.library.cstr.model import OPERATING_STATE, cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import FREE, PROFILES, STEP, Profile, free_profile
from reactorwatch.process.simulate import Simulator

START = np.array(OPERATING_STATE)
TIMES = np.arange(60, dtype=np.float64) * 0.1
FLOWS = np.repeat(np.random.default_rng(4).uniform(95, 108, 12), 5)

SHAPE = {"onset": 1.2345, "end": 3.4567, "time_constant": 2.0, "period": 25.0, "phase": 0.4}
SHAPE |= {"time_1": 1.2345, "value_1": 0.3, "time_2": 2.4567, "value_2": 1.0, "time_3": 4.1234, "value_3": 0.4}
SHAPES = (*(profile for profile in PROFILES if profile is not FREE), free_profile(3))


def differences(simulator: Simulator, values: dict[str, float], name: str, step: float) -> tuple[Array, Array]:
    up = simulator.run(TIMES, FLOWS, START, {**values, name: values[name] + step})
    down = simulator.run(TIMES, FLOWS, START, {**values, name: values[name] - step})
    return (up.states - down.states) / (2 * step), (up.outputs - down.outputs) / (2 * step)


def check(model: ProcessModel, values: dict[str, float], steps: dict[str, float]) -> None:
    simulator = Simulator(model)
    trajectory, found = simulator.run_with_sensitivities(TIMES, FLOWS, START, list(values), values)
    np.testing.assert_array_equal(trajectory.states, simulator.run(TIMES, FLOWS, START, values).states)
    for column, name in enumerate(values):
        of_states, of_outputs = differences(simulator, values, name, steps[name])
        # Derivatives below a ten-thousandth of these are the noise of differences; steps that are cut have more of it.
        no_effect = (0.2 if model.at_rest else 1e-4) * np.array([state.scale for state in model.states])
        for expected, got, least in ((of_states, found.states, no_effect), (of_outputs, found.outputs, no_effect[:2])):
            scale = np.max(np.abs(expected), axis=0) + least
            assert np.max(np.abs(got[:, :, column] - expected) / scale) < 1e-4, name


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
@pytest.mark.parametrize("profile", SHAPES, ids=lambda profile: profile.name)
def test_of_every_effect_with_every_profile(effect: Effect, profile: Profile) -> None:
    values = {f"{effect.name}.size": effect.typical}
    values |= {f"{effect.name}.{item.name}": SHAPE[item.name] for item in profile.parameters}
    moved = 1e-3 if effect.name == "concentration_delay" else 1e-4
    steps = dict.fromkeys(values, moved) | {f"{effect.name}.size": 1e-3 * effect.typical}
    check(effect.extend(cstr(), profile), values, steps)


def test_of_the_parameters_of_the_balances() -> None:
    model = cstr()
    values = {item.name: item.value for item in model.parameters}
    check(model, values, {name: 1e-6 * value for name, value in values.items()})


def test_of_the_start() -> None:
    """A start that moves with a parameter: the derivative of the run by its own initial state."""
    simulator = Simulator(cstr())
    initial = np.array([[1.0, 0.0], [0.0, 1.0]])
    _, found = simulator.run_with_sensitivities(TIMES, FLOWS, START, ["Cf", "Tf"], start_sensitivity=initial)
    _, fixed = simulator.run_with_sensitivities(TIMES, FLOWS, START, ["Cf", "Tf"])
    for column, step in enumerate((1e-6, 1e-3)):
        delta = step * initial[column]
        up, down = (simulator.run(TIMES, FLOWS, START + sign * delta).states for sign in (1, -1))
        expected = (up - down) / (2 * step)
        scale = np.max(np.abs(expected), axis=0)
        assert np.max(np.abs((found.states - fixed.states)[:, :, column] - expected) / scale) < 1e-4


def test_through_steps_that_had_to_be_cut() -> None:
    """An ignition is walked with steps of its own, and the derivatives go along."""
    simulator = Simulator(cstr())
    times, flows, start = np.arange(26, dtype=np.float64) * 0.1, np.full(26, 5.0), np.array([0.9, 372.0])
    trajectory, found = simulator.run_with_sensitivities(times, flows, start, ["Tf"])
    assert trajectory.states[-1, 1] > 500
    up, down = (simulator.run(times, flows, start, {"Tf": 350.0 + step}).states for step in (1e-3, -1e-3))
    expected = (up - down) / 2e-3
    scale = np.max(np.abs(expected), axis=0)
    assert np.max(np.abs(found.states[:, :, 0] - expected) / scale) < 1e-3


def test_an_onset_on_a_sample_has_the_derivative_towards_later_times() -> None:
    """It differs from that towards earlier times, where the input of the row before holds."""
    simulator = Simulator(CoolantFlow().extend(cstr(), STEP))
    values = {"coolant_flow.size": -0.1, "coolant_flow.onset": float(TIMES[15])}
    assert FLOWS[14] != FLOWS[15]
    trajectory, found = simulator.run_with_sensitivities(TIMES, FLOWS, START, ["coolant_flow.onset"], values)
    later = simulator.run(TIMES, FLOWS, START, {**values, "coolant_flow.onset": values["coolant_flow.onset"] + 1e-5})
    expected = (later.states - trajectory.states) / 1e-5
    assert np.all(found.states[:16] == 0)
    scale = np.max(np.abs(expected), axis=0)
    assert np.max(np.abs(found.states[:, :, 0] - expected) / scale) < 1e-3


def test_unknown_parameters_and_misshapen_starts_are_refused() -> None:
    simulator = Simulator(cstr())
    with pytest.raises(ValueError, match=r"^cstr has no parameter 'W'"):
        simulator.run_with_sensitivities(TIMES, FLOWS, START, ["W"])
    with pytest.raises(ValueError, match=r"^start_sensitivity must have shape \(2, 1\), got \(1, 2\)$"):
        simulator.run_with_sensitivities(TIMES, FLOWS, START, ["Tf"], start_sensitivity=np.zeros((1, 2)))
