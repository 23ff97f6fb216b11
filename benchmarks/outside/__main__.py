"""`make outside DATA=FOLDER`: all benchmarks whose data are in the folder, as one page of tables."""

import argparse
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.harness.study import stamp
from benchmarks.outside import reactors_and_tanks, tennessee, water_circuit
from benchmarks.outside.scores import Row, markdown

SEED = 1


@dataclass(frozen=True)
class Benchmark:
    """A benchmark."""

    title: str  # heading of its table
    data: str  # path of its data in the folder
    measure: Callable[[Path, int], list[Row]]  # function of that path and a seed that returns the rows of the table
    records: str  # sentence above the table that states how many records its numbers are from


ONE_OF_EACH = "One record of each fault."
ONE = "One record: models are fitted to its first part, and simulated along its second."

BENCHMARKS = (
    Benchmark("Tennessee Eastman: detection", "tep", tennessee.measure, tennessee.RECORDS),
    Benchmark("Tennessee Eastman: place of a fault", "tep", tennessee.measure_places, ONE_OF_EACH),
    Benchmark("SKAB: anomalies and change points", "skab", water_circuit.measure, water_circuit.RECORDS),
    Benchmark("Three tanks: cause and place", "three_tanks", reactors_and_tanks.measure_faults, ONE_OF_EACH),
    Benchmark("Cascaded tanks: simulation", "cascaded_tanks", reactors_and_tanks.measure_tanks, ONE),
    Benchmark("DaISy reactor: simulation", "daisy_cstr.csv", reactors_and_tanks.measure_reactor, ONE),
)


def main() -> int:
    """Run the benchmarks and print their tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the benchmarks' data")
    parser.add_argument("--only", help="part of a title, such as SKAB")
    parser.add_argument("--write", type=Path, help="file whose text between two marks the tables replace")
    options = parser.parse_args()
    parts = [
        measure_benchmark(item, options.data)
        for item in BENCHMARKS
        if (options.only or "").lower() in item.title.lower()
    ]
    print("\n\n".join(parts))
    if options.write:
        options.write.write_text(replace_tables(options.write.read_text(encoding="utf-8"), parts), encoding="utf-8")
    return 0


BEGIN, END = "<!-- tables: begin -->", "<!-- tables: end -->"


def replace_tables(page: str, tables: list[str]) -> str:
    """The page with tables in place of those with the same titles; other titles between the two marks stay."""
    head, _, rest = page.partition(BEGIN)
    present, _, tail = rest.partition(END)
    by_title = {part.partition("\n")[0]: part.strip() for part in re.split(r"(?m)^## ", present)[1:]}
    by_title |= {part.removeprefix("## ").partition("\n")[0]: part.removeprefix("## ").strip() for part in tables}
    text = "\n\n".join(f"## {part}" for part in by_title.values())
    return f"{head}{BEGIN}\n\n{text}\n\n{END}{tail}"


def measure_benchmark(benchmark: Benchmark, folder: Path) -> str:
    """Table of a benchmark, or the reason why there is none."""
    path = folder / benchmark.data
    if not path.exists():
        return f"## {benchmark.title}\n\nNot measured: {path.name} is not in the folder."
    rows = benchmark.measure(path, SEED)
    return f"## {benchmark.title}\n\n{stamp()} {benchmark.records}\n\n{markdown(rows)}"


if __name__ == "__main__":
    raise SystemExit(main())
