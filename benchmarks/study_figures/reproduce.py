"""Draws the figures that are asked for and writes the page."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.study_figures.canvas import paper, require_matplotlib
from benchmarks.study_figures.catalogue import FIGURES
from benchmarks.study_figures.figure import Figure, Finding
from benchmarks.study_figures.measured_records import measured_figure
from benchmarks.study_figures.page import FOLDER, page
from benchmarks.study_figures.study import Study
from reactorwatch.cli.batch import results_in_order
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.records.record import Record
from reactorwatch.records.write import atomic_write, check_output_folder, fill_folder, make_folder
from reactorwatch.runtime.parallel.jobs import Failed
from reactorwatch.terminal import printable_lines

PAGE = "study.md"


@dataclass(frozen=True)
class Job:
    """A figure to be drawn."""

    key: str  # key of the figure
    picture: Path  # file of the picture
    seed: int  # seed of every simulated record
    measured: Record | None  # a record that models are identified from, or None
    data: Path | None = None  # folder of records of others, or None


def reproduce(
    out: Path,
    seed: int,
    only: str | None = None,
    measured: Record | None = None,
    *,
    data: Path | None = None,
    processes: int | None = 1,
) -> str:
    """Write `out`/study.md and its pictures."""
    figures = _select_figures(only, data)
    require_matplotlib()
    check_output_folder(check_output_folder(out) / FOLDER)
    found: list[tuple[Figure, Finding]] = []
    with fill_folder(out) as folder:
        pictures = make_folder(folder / FOLDER).absolute()
        jobs = [Job(figure.key, pictures / figure.file_name, seed, measured, data) for figure in figures]
        with results_in_order(draw, jobs, "reproducing", processes, None) as findings:
            for figure, finding in zip(figures, findings, strict=True):
                if isinstance(finding, Failed):
                    raise (RuntimeError if finding.is_internal else InputError)(f"{figure.heading}: {finding.reason}")
                found.append((figure, finding))
        text = page(found, seed, measured.name if measured else "")
        with atomic_write(folder / PAGE) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return _report(out, found)


def check_out(
    out: Path, only: str | None, sources: Iterable[Path | None], *, data: Path | None = None, force: bool
) -> None:
    """Check that the page and its pictures may be written; arguments as for `reproduce` and `check_output_file`."""
    pictures = [f"{FOLDER}/{figure.file_name}" for figure in _select_figures(only, data)]
    check_output_folder(out, (PAGE, *pictures), sources, force=force)


def draw(job: Job) -> Finding:
    """Draw a figure."""
    (figure,) = (item for item in _entries(job.data) if item.key == job.key)
    with paper(job.picture, figure.height_px) as drawing:
        return figure.draw(Study(job.seed, job.measured), drawing)


def _entries(data: Path | None) -> Sequence[Figure]:
    return FIGURES if data is None else (*FIGURES, measured_figure(data))


def _select_figures(only: str | None, data: Path | None = None) -> Sequence[Figure]:
    if only is None:
        return _entries(data)
    keys = {figure.key: figure for figure in _entries(data)}
    wanted = [part.strip() for part in only.split(",")]
    for part in wanted:
        if part not in keys:
            raise InputError(f"--only: {describe_unknown('figure', part, keys)}")
    return [keys[key] for key in keys if key in wanted]


def _report(out: Path, found: Sequence[tuple[Figure, Finding]]) -> str:
    lines = [f"  {figure.heading}: {finding.verdict.value}" for figure, finding in found]
    return printable_lines([f"wrote {out / PAGE} and {len(found)} pictures; the report's claims are:", *lines])
