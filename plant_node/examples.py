"""Sample records of the shipped processes: simulated, each with its known truth."""

from typing import Any

import msgspec

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.process import MODELS, OPERATIONS, effects_of
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.operation import Example
from reactorwatch.records.record import Record

EXAMPLES: dict[str, Example] = {
    name: example for operation in OPERATIONS.values() for name, example in operation.examples.items()
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
    example = EXAMPLES[name]
    model = next(item for item in (make() for make in MODELS) if name in OPERATIONS[item.name].examples)
    config = msgspec.convert({**example.settings, "seed": seed, "faults": example.faults}, PlantConfig)
    simulated = model if example.with_law is None else example.with_law(model)
    record = simulate_record(config, example.rows, simulated)
    faults = [parse_fault(text, effects_of(model)) for text in example.faults]
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
    truth: dict[str, Any] = {"process": model.name, "seed": seed, "causes": causes}
    return record, truth if example.law is None else truth | {"law": example.law}
