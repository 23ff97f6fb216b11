"""Sample records of the reactor: simulated, each with its known truth."""

from dataclasses import dataclass
from typing import Any

import casadi as ca

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.process.effect import Effect
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record

ROWS = 2400
"""Four hours at the plant's period of 0.1 min."""

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


@dataclass(frozen=True)
class Example:
    """A sample record.

    Attributes:
        meaning: a one-line description.
        faults: specifications of the faults in it, with onsets and ends.
        law: law in it that no cause of the catalogue has; None: there is none.
    """

    meaning: str
    faults: tuple[str, ...] = ()
    law: str | None = None


EXAMPLES: dict[str, Example] = {
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
    ),
}
"""The sample records, by name."""


def make_example(name: str, seed: int) -> tuple[Record, dict[str, Any]]:
    """Simulate a sample record; returns it and its truth, as `FILE.truth.json` has it.

    Args:
        name: name in `EXAMPLES`.
        seed: seed of the input and the noise.

    Raises:
        InputError: there is no such example, or the seed is out of range.
    """
    if name not in EXAMPLES:
        raise InputError(describe_unknown("example", name, EXAMPLES))
    example, model = EXAMPLES[name], cstr()
    if example.law is not None:
        model = Boiling().extend(model).with_values({"boiling.size": BOILING_RATE})
    record = simulate_record(PlantConfig(seed=seed, faults=example.faults), ROWS, model)
    faults = [parse_fault(text) for text in example.faults]
    causes = [
        {
            "cause": fault.effect.name,
            "profile": fault.profile.name,
            "size": fault.values["size"],
            "unit": fault.effect.unit,
            "onset_min": fault.values["onset"],
        }
        for fault in faults
    ]
    truth: dict[str, Any] = {"process": "cstr", "seed": seed, "causes": causes}
    return record, truth if example.law is None else truth | {"law": example.law}
