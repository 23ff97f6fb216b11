"""Sample records of the reactor."""

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.operation import Example

BOILING_FROM_K = 440.0
BOILING_RATE = 0.6
"""1/min."""


class Boiling(Effect):
    """-m max(T - 440 K, 0) in the energy balance: heat of evaporation. It is in no catalogue of causes."""

    name = "boiling"
    label = "boiling of the contents"
    location = "energy_balance"
    unit = "1/min"
    lower = 0.0
    upper = 10.0
    typical = 0.1

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        T = model.states[model.state_index("T")].symbol
        return model.add_rate("T", -size * ca.fmax(T - BOILING_FROM_K, 0))


def _boil(model: ProcessModel) -> ProcessModel:
    return Boiling().extend(model).with_values({"boiling.size": BOILING_RATE})


EXAMPLES = {
    "sound": Example("nothing is wrong"),
    "leak": Example("15 % of the coolant is lost from minute 150 on", ("coolant_flow:step:-0.15@150min",)),
    "fouling": Example(
        "heat transfer falls by 30 % from minute 120 on", ("heat_transfer:ramp:-0.3@120min,end=239.9min",)
    ),
    "analyser_drift": Example(
        "the concentration reading drifts by 0.01 mol/l from minute 120 on",
        ("concentration_bias:ramp:0.01@120min,end=239.9min",),
    ),
    "two_causes": Example(
        "10 % of the coolant is lost, later the thermometer reads 1.5 K too high",
        ("coolant_flow:step:-0.1@130min", "temperature_bias:step:1.5@180min"),
    ),
    "unknown": Example(
        "the contents boil above 440 K all the time, which is no cause of the catalogue",
        law=f"energy balance: -{BOILING_RATE:g} 1/min max(T - {BOILING_FROM_K:g} K, 0)",
        with_law=_boil,
    ),
}
"""The sample records, by name: four hours at the plant's period of 0.1 min."""
