"""`make inexact`: diagnoses of records that no model equals to the sample, drawn apart from the product.

    python -m benchmarks.inexact two-heaters|foreign|reactor [--n N] [--sound N] [--seed S] [--only CLASS]
                                                             [--out FILE.jsonl] [--files FOLDER] [--jobs N]

Every record is written to a file, and diagnosed by `reactorwatch diagnose --json` with a process file, as by a user.
`--out` keeps a line of JSON for each: a later run with this file diagnoses only what is missing in it. `--files` writes
the records, their truth and the process files into a folder, and diagnoses nothing.
"""

import argparse
import json
import resource
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness.study import Pool
from benchmarks.inexact import two_heaters
from benchmarks.inexact.records import Drawn, write_files
from benchmarks.inexact.scores import failed_score, score, table
from benchmarks.outside.scores import run
from reactorwatch.errors import InputError

PLANTS: dict[str, Callable[[int, int, bool], Drawn]] = {
    "two-heaters": two_heaters.draw,
}
"""Functions of a seed, a number, and whether the plant is sound, that draw a record."""

Job = tuple[str, int, int, bool]
"""Plant, seed, number, and whether the plant is sound."""


def draw_record(job: Job) -> Drawn:
    """Draw a record."""
    return PLANTS[job[0]](*job[1:])


def diagnose_record(job: Job) -> dict[str, Any]:
    """Draw a record, diagnose it by the command, and score what it prints."""
    drawn = draw_record(job)
    with tempfile.TemporaryDirectory() as folder:
        path, process = write_files(drawn, Path(folder))
        before = _children_s()
        try:
            found = score(drawn.truth, json.loads(run("diagnose", str(path), "--process", process, "--json")))
        except InputError as error:
            found = failed_score(drawn.truth, str(error))
    return {"truth": drawn.truth, "score": found, "cpu_s": round(_children_s() - before, 2)}


def _children_s() -> float:
    """CPU time of all child processes that ended, s."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose the records and print the table, or write their files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plant", choices=sorted(PLANTS))
    parser.add_argument("--n", type=int, default=40, help="records with a cause")
    parser.add_argument("--sound", type=int, default=20, help="records without")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="one class, such as lag")
    parser.add_argument("--out", type=Path, metavar="FILE.jsonl", help="file that keeps each result")
    parser.add_argument("--files", type=Path, metavar="FOLDER", help="write the records and diagnose nothing")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    options = parser.parse_args(arguments)
    if options.out is not None and options.out.suffix != ".jsonl":
        parser.error(f"--out must end in .jsonl, got {options.out.name}")
    numbers = [(i, False) for i in range(options.n)] + [(i, True) for i in range(options.sound)]
    jobs: list[Job] = [(options.plant, options.seed, *item) for item in numbers]
    if options.only:
        jobs = [job for job in jobs if draw_record(job).group == options.only]
    if options.files:
        for job in jobs:
            write_files(draw_record(job), options.files)
        return 0
    print(table(Pool(options.jobs, results=options.out).run("inexact", diagnose_record, jobs)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
