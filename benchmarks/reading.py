"""Rate of reading tables, as a multiple of numpy.loadtxt in the same run.

    python benchmarks/reading.py            a million rows
    python benchmarks/reading.py --rows 100000

Each file is read in turn with numpy.loadtxt, and the best of the repetitions counts: other load on the machine makes
single times longer, never shorter. The goal is 4.
"""

import argparse
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.harness.timing import fastest
from reactorwatch.description.read import find_process, read_process_table
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table

ROWS = 1_000_000
REPETITIONS = 5
GOAL = 4.0


def make_record(rows: int, digits: int | None) -> Record:
    """Simulated values of the reactor's signals; `digits` after the point, None: all 17."""
    generator = np.random.default_rng(1)
    columns = {
        name: generator.normal(mean, sd, rows) for name, mean, sd in (("qc", 103, 4), ("C", 0.1, 0.01), ("T", 440, 2))
    }
    if digits is not None:
        columns = {name: np.round(values, digits) for name, values in columns.items()}
    return Record(np.arange(rows) / 10, columns, "made")


def write_german(path: Path, source: Path) -> None:
    """Write a file with semicolons and decimal commas."""
    path.write_text(source.read_text().replace(",", ";").replace(".", ","))


def write_stamps(path: Path, record: Record) -> None:
    """Write a file with timestamps instead of minutes."""
    stamps = np.datetime64("2026-03-01T08:00", "ms") + np.round(record.time_min * 60_000).astype("timedelta64[ms]")
    rows = zip(stamps.astype(str), *(values.tolist() for values in record.columns.values()), strict=True)
    with path.open("w") as file:
        file.write(f"timestamp,{','.join(record.columns)}\n")
        file.writelines(f"{','.join(map(str, row))}\n" for row in rows)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=ROWS)
    parser.add_argument("--repetitions", type=int, default=REPETITIONS)
    arguments = parser.parse_args()
    with TemporaryDirectory() as folder:
        full, short, german, stamps = (Path(folder) / f"{name}.csv" for name in ("full", "short", "german", "stamps"))
        write_table(full, make_record(arguments.rows, None))
        write_table(short, make_record(arguments.rows, 4))
        write_german(german, short)
        write_stamps(stamps, make_record(arguments.rows, 4))
        print(f"{arguments.rows} rows of 4 columns, the best of {arguments.repetitions}")
        peers: dict[Path, float] = {}
        for path, peer in ((full, full), (short, short), (german, short), (stamps, short)):
            if peer not in peers:
                load = partial(np.loadtxt, peer, delimiter=",", skiprows=1)
                peers[peer], _ = fastest(load, arguments.repetitions)
            ours, _ = fastest(partial(read_process_table, path, find_process()), arguments.repetitions)
            print(f"{path.stem:8} {ours:7.3f} s  {peers[peer] / ours:5.1f} times numpy.loadtxt of {peer.stem}")
        print(f"goal: {GOAL:g} for full and short")


if __name__ == "__main__":
    main()
