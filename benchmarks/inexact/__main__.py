"""`make inexact`: diagnoses of records that are not quite their model, drawn apart from the product.

    python -m benchmarks.inexact two-heaters|foreign|reactor [--n N] [--sound N] [--seed S] [--only CLASS]
                                                             [--out FILE.jsonl] [--files FOLDER] [--live]

Every record is written to a file, and diagnosed by `reactorwatch diagnose --json` with a process file, as by a user.
`--out` keeps a line of JSON for each: a later run with this file diagnoses only what is missing in it. `--files` writes
the records, their truth and the process files into a folder, and diagnoses nothing. `--live` watches the records with a
cause until `AFTER_MIN` after its onset by `reactorwatch backtest`, and scores the suspects of the last alarm.
"""

import argparse
import json
import resource
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness.study import Pool
from benchmarks.inexact import foreign, reactor, two_heaters
from benchmarks.inexact.records import Drawn, write_files
from benchmarks.inexact.scores import SUSPECTS, score, score_suspects, table
from benchmarks.outside.scores import run
from reactorwatch.errors import InputError

PLANTS = {"two-heaters": two_heaters.draw, "foreign": foreign.draw, "reactor": reactor.draw}

AFTER_MIN = 30.0
"""Time after the onset at which suspects are scored."""

Job = tuple[str, int, int, bool]
"""Plant, seed, number, and whether the plant is sound."""


def draw_record(job: Job) -> Drawn:
    """Draw a record."""
    return PLANTS[job[0]](*job[1:])


def diagnose_record(job: Job) -> dict[str, Any]:
    """Draw a record, diagnose it by the command, and score what it prints."""
    drawn, before_s = draw_record(job), _children_s()
    try:
        result = score(drawn.truth, _run_on(drawn, "diagnose"))
    except InputError as error:
        nothing = {"verdict": "error", "causes": [], "alternatives": [], "practical": False}
        result = score(drawn.truth, nothing) | {"error": str(error)}
    return _line(drawn, result, before_s)


def watch_record(job: Job) -> dict[str, Any]:
    """Draw a record, watch it until some time after the onset by the command, and score its last suspects.

    The first third of the whole record is the training, as without an option.
    """
    drawn, before_s = draw_record(job), _children_s()
    assert drawn.cause is not None
    assert drawn.cause.onset_min is not None
    rows = len(next(iter(drawn.columns.values())))
    until = min(int((drawn.cause.onset_min + AFTER_MIN) / drawn.period_min) + 1, rows)
    shorter = drawn._replace(columns={name: values[:until] for name, values in drawn.columns.items()})
    alarms = _run_on(shorter, "backtest", "--training-rows", str(rows // 3))["alarms"]
    return _line(drawn, score_suspects(drawn.truth, alarms[-1]["suspect"] if alarms else []), before_s)


def _run_on(drawn: Drawn, command: str, *options: str) -> dict[str, Any]:
    """Write a record and its process, and read a command's JSON."""
    with tempfile.TemporaryDirectory() as folder:
        path, process = write_files(drawn, Path(folder))
        found: dict[str, Any] = json.loads(run(command, str(path), "--process", process, *options, "--json"))
    return found


def _line(drawn: Drawn, result: dict[str, Any], before_s: float) -> dict[str, Any]:
    """A record's line of the results, with the CPU time of its command."""
    return {"truth": drawn.truth, "score": result, "cpu_s": round(_children_s() - before_s, 2)}


def _children_s() -> float:
    """CPU time of all child processes that ended, s."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main(arguments: Sequence[str] | None = None) -> int:
    """Diagnose the records and print the table, or write their files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plant", choices=PLANTS)
    parser.add_argument("--n", type=int, default=40, help="records with a cause")
    parser.add_argument("--sound", type=int, default=20, help="records without")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="one class, such as lag")
    parser.add_argument("--out", type=Path, metavar="FILE.jsonl", help="file that keeps each result")
    parser.add_argument("--live", action="store_true", help="watch the records with a cause")
    parser.add_argument("--files", type=Path, metavar="FOLDER", help="write the records and diagnose nothing")
    options = parser.parse_args(arguments)
    numbers = [*((i, False) for i in range(options.n)), *((i, True) for i in range(options.sound))]
    jobs: list[Job] = [(options.plant, options.seed, *item) for item in numbers]
    if options.only:
        jobs = [job for job in jobs if draw_record(job).group == options.only]
    if options.files:
        for job in jobs:
            write_files(draw_record(job), options.files)
    elif options.live:
        jobs = [job for job in jobs if not job[-1]]
        print(table(Pool(1, results=options.out).run("inexact, live", watch_record, jobs), SUSPECTS))
    else:
        print(table(Pool(1, results=options.out).run("inexact", diagnose_record, jobs)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
