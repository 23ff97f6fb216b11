"""`example`: sample records with their truth."""

from typing import TYPE_CHECKING, Any

from reactorwatch.errors import InputError, describe_unknown

if TYPE_CHECKING:
    from reactorwatch.records.record import Record


def make_example(name: str, seed: int) -> "tuple[Record, dict[str, Any], str]":
    """Simulate a sample record; returns it, its truth, as `FILE.truth.json` has it, and its meaning in a line."""
    import msgspec

    from plant_node.config import PlantConfig
    from plant_node.record import simulate_record
    from reactorwatch.process import MODELS, OPERATIONS, effects_of
    from reactorwatch.process.fault import parse_fault

    models = {example: make for make in MODELS for example in OPERATIONS[make().name].examples}
    if name not in models:
        raise InputError(describe_unknown("example", name, models))
    model = models[name]()
    example = OPERATIONS[model.name].examples[name]
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
    return record, truth if example.law is None else truth | {"law": example.law}, example.meaning
