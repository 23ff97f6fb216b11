"""Transfer of a state into a model that has other states."""

from dataclasses import replace
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.record import plant_from
from reactorwatch.errors import InputError
from reactorwatch.process.effect import Effect
from reactorwatch.process.fault import FaultSpecification
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.model import ProcessModel, variable
from reactorwatch.process.profiles import CONSTANT
from reactorwatch.process.steady_state import complete_state, start_state


class Thermowell(Effect):
    """The measured temperature follows T with a time constant of 1 min and a coefficient of size m."""

    name: ClassVar[str] = "thermowell"
    label: ClassVar[str] = "slow thermometer"
    location: ClassVar[str] = "temperature_sensor"
    unit: ClassVar[str] = "1"
    lower: ClassVar[float] = 0.0
    upper: ClassVar[float] = 1.0

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        well = variable("T_well", "K", (250.0, 700.0), 10.0, "temperature of the thermowell")
        T = model.states[model.state_names.index("T")].symbol
        return replace(
            model,
            states=(*model.states, well),
            rhs=(*model.rhs, T - well.symbol),
            outputs=tuple(
                replace(item, expression=(1 - size) * item.expression + size * well.symbol)
                if item.name == "T"
                else item
                for item in model.outputs
            ),
        )


QC = np.array([100.0])


def test_new_states_begin_at_rest_and_known_ones_go_over_by_name() -> None:
    model = Thermowell().extend(cstr())
    found = complete_state(model, {"T": 431.0, "C": 0.1, "gone": 7.0}, QC, 0.0)
    np.testing.assert_allclose(found, [0.1, 431.0, 431.0], rtol=1e-12)


def test_steady_states_are_distinguished_by_temperature_whatever_the_last_state_is() -> None:
    """Against the published three at 103.41 l/min."""
    model, qc = Thermowell().extend(cstr()), np.array([103.41])
    reversed_ = replace(model, states=model.states[::-1], rhs=model.rhs[::-1])
    assert start_state(reversed_, qc, "operating") == pytest.approx([438.5417, 438.5417, 0.1000129], abs=5e-5)
    assert start_state(model, qc, "extinguished") == pytest.approx([0.96389, 353.553, 353.553], abs=5e-4)


def test_a_fault_with_a_state_of_its_own_comes_and_goes_without_a_jump() -> None:
    config = PlantConfig(noise_sd={"C": 0, "T": 0}, start={"C": 0.2, "T": 430.0}, scenario="constant")
    running, undisturbed = (plant_from(config) for _ in range(2))
    slow = FaultSpecification(Thermowell(), CONSTANT, {"size": 1.0})
    true, measured = [], []
    for number in range(60):
        if number == 20:
            running.inject(slow)
        if number == 40:
            running.clear("thermowell")
        true.append(undisturbed.next_row().readings["T"])
        measured.append(running.next_row().readings["T"])
    np.testing.assert_allclose(measured[:21], true[:21], rtol=0, atol=1e-9)
    assert max(abs(a - b) for a, b in zip(measured[21:40], true[21:40], strict=True)) > 0.1
    np.testing.assert_allclose(measured[40:], true[40:], rtol=0, atol=1e-4)


def test_a_state_that_can_nowhere_rest_is_named() -> None:
    model = cstr()
    drifting = replace(model, rhs=(model.rhs[0], ca.exp(model.states[1].symbol / 1e3)))
    with pytest.raises(InputError, match=r"^cstr: T cannot be at rest while \{'C': 0\.1\}; give a start for them$"):
        complete_state(drifting, {"C": 0.1}, QC, 0.0)
