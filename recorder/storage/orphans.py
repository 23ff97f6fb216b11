"""What killed recorders left behind: found at a start, and made whole while recording goes on."""

from pathlib import Path

import structlog

from reactorwatch.errors import InputError
from recorder.policy.series import Series
from recorder.storage.mcap_scan import Scan
from recorder.storage.part_file import PART, is_held, left_behind
from recorder.storage.recover import origin, recover

log = structlog.get_logger()

DAMAGED = ".damaged"
"""The ending of a file left behind from which not all could be recovered: it is kept as long as a recording is."""


def remains_of(series: Series) -> list[Path]:
    """What killed recorders left behind.

    Raises:
        InputError: the file that was asked for by name is being written by another recorder.
    """
    found = []
    for part in sorted(series.folder.glob(f"*{PART}")):
        name = part.name.removesuffix(PART)
        if series.owns(name):
            if not is_held(part):
                found.append(part)
            elif not series.dated:
                raise InputError(f"recording {part.with_name(name)}: {part} is being written by another recorder")
    for copy in series.folder.glob(f".{series.stem}*.tmp{PART}"):
        if not is_held(copy):
            copy.unlink(missing_ok=True)  # it was being made when its maker was killed
    return found


def damaged(series: Series) -> list[Path]:
    """What was kept because not all of it could be recovered."""
    ending = PART + DAMAGED
    there = series.folder.glob(f"*{ending}")
    return [path for path in there if series.owns(path.name.removesuffix(ending))]


def make_whole(part: Path) -> None:
    """Make a file whole that was left behind. It is deleted only if nothing but its end is missing."""
    with left_behind(part):
        path = part.with_name(part.name.removesuffix(PART))
        if path.exists() and not _is_of(path, part):
            path = path.with_name(f"{path.stem}-recovered{path.suffix}")
        if _is_empty(part):
            part.unlink()
            log.info("nothing was in it yet", file=str(part))
            return
        try:
            saved = recover(part, path)
        except InputError as error:
            part.rename(part.with_name(part.name + DAMAGED))
            log.warning("nothing recovered", why=str(error))
            return
        if saved.only_cut_off:
            part.unlink()
        else:
            part.rename(part.with_name(part.name + DAMAGED))
        log.info("recovered", file=str(path), messages=saved.messages, lost=saved.lost)


def _is_empty(part: Path) -> bool:
    """Whether a file was left behind before anything that it received was handed over."""
    try:
        scan = Scan(part)
        return not any(True for _ in scan) and not scan.orphans and all(damage.cut_off for damage in scan.damages)
    except InputError:
        return part.stat().st_size == 0


def _is_of(path: Path, part: Path) -> bool:
    """Whether a file was recovered from another, by a recorder that was killed before it could delete that one."""
    try:
        return origin(path) == origin(part) != {}
    except InputError:
        return False
