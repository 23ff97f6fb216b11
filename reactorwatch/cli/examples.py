"""`example`: sample records with their truth."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from reactorwatch.cli.options import Force, check_output
from reactorwatch.cli.printing import print_lines
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.records.write import check_output_file

if TYPE_CHECKING:
    from reactorwatch.records.record import Record


def example(
    name: Annotated[
        str,
        Argument(
            help="Of cstr: sound, leak, fouling, analyser_drift, two_causes or unknown (a law in no catalogue); "
            "three_tanks or cascaded_tanks.",
        ),
    ],
    out: Annotated[Path, Option("--out", "-o", help="The file to write; the truth is written beside it.")],
    seed: Annotated[int, Option(help="Of the input and the noise.", min=0, max=2**63 - 1)] = 3,
    force: Force = False,
) -> None:
    """Write a simulated sample record (.csv, .csv.gz, .xlsx or .parquet), its truth in FILE.truth.json."""
    import msgspec

    from reactorwatch.cli.progress import task
    from reactorwatch.records.write import WRITTEN_SUFFIXES, atomic_write, write_table

    out = check_output(out, WRITTEN_SUFFIXES, (), force=force)
    beside = check_output_file(out.with_name(f"{out.name}.truth.json"), force=force)
    with task(f"simulating {name}"):
        record, truth, meaning = make_example(name, seed)
    write_table(out, record)
    with atomic_write(beside) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(truth)) + b"\n")
    print_lines(f"wrote {out}: {record.rows} rows; {meaning}", f"wrote {beside}")


def make_example(name: str, seed: int) -> "tuple[Record, dict[str, Any], str]":
    """Simulate a sample record; returns it, its truth, as `FILE.truth.json` has it, and its meaning in a line.

    Raises:
        InputError: there is no such example, or the seed is out of range.
    """
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
