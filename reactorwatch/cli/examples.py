"""`example`: sample records with their truth."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from reactorwatch.cli.options import Force, check_output
from reactorwatch.cli.printing import print_lines
from reactorwatch.records.output import check_output_file


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

    from plant_node.record import EXAMPLES, make_example
    from reactorwatch.cli.progress import task
    from reactorwatch.records.atomic import atomic_write
    from reactorwatch.records.write_table import WRITTEN_SUFFIXES, write_table

    out = check_output(out, WRITTEN_SUFFIXES, (), force=force)
    beside = check_output_file(out.with_name(f"{out.name}.truth.json"), force=force)
    with task(f"simulating {name}"):
        record, truth = make_example(name, seed)
    write_table(out, record)
    with atomic_write(beside) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(truth)) + b"\n")
    print_lines(f"wrote {out}: {record.rows} rows; {EXAMPLES[name].meaning}", f"wrote {beside}")
