"""`reproduce`: draws the figures that are asked for and writes the page."""

from collections.abc import Sequence
from pathlib import Path

from reactorwatch.cli.progress import bar
from reactorwatch.cli.study.canvas import paper, require_matplotlib
from reactorwatch.cli.study.catalogue import FIGURES
from reactorwatch.cli.study.figure import Figure, Finding
from reactorwatch.cli.study.page import FOLDER, page
from reactorwatch.cli.study.study import Study
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import replacing
from reactorwatch.records.record import Record

PAGE = "study.md"


def reproduce(out: Path, seed: int, only: str | None = None, measured: Record | None = None) -> str:
    """Write `out`/study.md and its pictures.

    Args:
        out: folder; made if it is not there.
        seed: of every simulated record.
        only: numbers of figures, such as `7,12`; all, if not given.
        measured: a record that figures 14 to 17 identify their models from.

    Returns:
        What was written, for people.

    Raises:
        InputError: figures that there are not, a folder that cannot be written to, or matplotlib is not installed.
    """
    figures = _chosen(only)
    require_matplotlib()
    pictures = _folder(out)
    study = Study(seed, measured)
    found: list[tuple[Figure, Finding]] = []
    with bar("reproducing", len(figures)) as advance:
        for done, figure in enumerate(figures):
            advance(done, f"figure {figure.number}")
            with paper(pictures / figure.file_name, figure.height_px) as drawing:
                found.append((figure, figure.draw(study, drawing)))
    text = page(found, seed, measured.name if measured else "")
    with replacing(out / PAGE) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return _report(out, found)


def _chosen(only: str | None) -> Sequence[Figure]:
    if only is None:
        return FIGURES
    numbers = [figure.number for figure in FIGURES]
    wanted = [part.strip() for part in only.split(",")]
    for part in wanted:
        if part not in map(str, numbers):
            raise InputError(
                f"--only must be numbers of figures from {numbers[0]} to {numbers[-1]}, such as 7,12, got {part!r}"
            )
    return [figure for figure in FIGURES if str(figure.number) in wanted]


def _folder(out: Path) -> Path:
    """The folder of the pictures, made with that of the page."""
    pictures = out / FOLDER
    for folder in (out, pictures):
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file, a folder was expected")
    try:
        pictures.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {pictures}: {error.strerror}") from error
    return pictures


def _report(out: Path, found: Sequence[tuple[Figure, Finding]]) -> str:
    lines = [f"  {figure.number:>2}  {figure.title}: {finding.verdict.value}" for figure, finding in found]
    return "\n".join([f"wrote {out / PAGE} and {len(found)} pictures; compared with the report:", *lines])
