"""Draw every figure of the original report, and write a page of them: `make reproduce [DATA=folder] [OUT=folder]`."""

import argparse
import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.runtime.crash import guard


def main(words: Sequence[str] | None = None) -> int:
    """Draw the figures; returns an exit code."""
    # Before NumPy is imported: the last bits of a limit depend on the number of threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    return guard("reproduce", partial(_reproduce, _arguments(words)))


def _arguments(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="reproduce", description="Draw every figure of the original report.")
    parser.add_argument("--out", "-o", type=Path, required=True, help="folder for study.md and its pictures")
    parser.add_argument("--seed", type=int, default=1, help="seed of every simulated record (default: 1)")
    parser.add_argument("--only", help="figures by number, such as 7,12 (default: all)")
    parser.add_argument("--record", type=Path, help="a record that figures 5, 6, 11 to 16 learn from")
    parser.add_argument("--data", type=Path, help="a folder of records of others, for an entry on measured records")
    parser.add_argument("--jobs", type=int, help="processes (default: one a core)")
    parser.add_argument("--force", action="store_true", help="replace files that are no text or picture")
    return parser.parse_args(words)


def _reproduce(asked: argparse.Namespace) -> int:
    from benchmarks.study_figures.reproduce import check_out, reproduce
    from reactorwatch.api.files import record
    from reactorwatch.cli.display import print_report
    from reactorwatch.cli.options import check_recording

    if asked.seed < 0:
        raise InputError(f"--seed: must be at least 0, got {asked.seed}")
    if asked.data is not None and not asked.data.is_dir():
        raise InputError(f"--data {asked.data}: must be a folder of records, and there is none of that name")
    check_out(asked.out, asked.only, (asked.record, asked.data), data=asked.data, force=asked.force)
    measured = None if asked.record is None else record(check_recording(asked.record))
    if measured is not None and measured.runs is not None:
        raise InputError(f"--record {asked.record}: must be one run, {measured.describe_runs()}; cut one run out of it")
    print_report(reproduce(asked.out, asked.seed, asked.only, measured, data=asked.data, processes=asked.jobs))
    return 0


if __name__ == "__main__":
    sys.exit(main())
