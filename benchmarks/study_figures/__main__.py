"""Draw every figure of the original report, and write a page of them: `make reproduce [DATA=folder] [OUT=folder]`."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.harness.study import Pool

if TYPE_CHECKING:
    from benchmarks.study_figures.study import Figure

PAGE = "study.md"


def main(words: Sequence[str] | None = None) -> int:
    """Draw the figures; returns an exit code."""
    # Before NumPy is imported: the last bits of a limit depend on the number of threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    parser = argparse.ArgumentParser(prog="reproduce", description="Draw every figure of the original report.")
    parser.add_argument("--out", "-o", type=Path, required=True, help="folder for study.md and its pictures")
    parser.add_argument("--seed", type=int, default=1, help="seed of every simulated record (default: 1)")
    parser.add_argument("--only", help="figures by number, such as 7,12 (default: all)")
    parser.add_argument("--data", type=Path, help="a folder of records of others, for an entry on measured records")
    parser.add_argument("--jobs", type=int, help="processes (default: one a core)")
    asked = parser.parse_args(words)
    print(reproduce(asked.out, asked.seed, asked.only, data=asked.data, processes=asked.jobs))
    return 0


def reproduce(
    out: Path, seed: int, only: str | None = None, *, data: Path | None = None, processes: int | None = 1
) -> str:
    """Write `out`/study.md and its pictures; returns what was written, for people."""
    from benchmarks.study_figures.catalogue import FOLDER, Job, draw, page
    from reactorwatch.records.write import atomic_write, fill_folder, make_folder

    figures = _select_figures(only, data)
    with fill_folder(out) as folder:
        pictures = make_folder(folder / FOLDER).absolute()
        jobs = [Job(figure.key, pictures / figure.file_name, seed, data) for figure in figures]
        found = list(zip(figures, Pool(processes).run("figures", draw, jobs), strict=True))
        with atomic_write(folder / PAGE) as temporary:
            temporary.write_text(page(found, seed), encoding="utf-8")
    lines = [f"  {figure.heading}: {finding.verdict.value}" for figure, finding in found]
    return "\n".join([f"wrote {out / PAGE} and {len(found)} pictures; the report's claims are:", *lines])


def _select_figures(only: str | None, data: Path | None) -> "Sequence[Figure]":
    from benchmarks.study_figures.catalogue import entries
    from reactorwatch.errors import InputError, describe_unknown

    keys = {figure.key: figure for figure in entries(data)}
    wanted = list(keys) if only is None else [part.strip() for part in only.split(",")]
    for part in wanted:
        if part not in keys:
            raise InputError(f"--only: {describe_unknown('figure', part, keys)}")
    return [keys[key] for key in keys if key in wanted]


if __name__ == "__main__":
    sys.exit(main())
