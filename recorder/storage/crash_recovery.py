"""Crash recovery: find and repair recordings that a killed recorder has not finished."""

from pathlib import Path

import structlog

from reactorwatch.errors import InputError
from recorder.policy.file_names import FileNames
from recorder.storage.mcap_scan import Scan
from recorder.storage.part_file import PART, is_locked, lock_orphan
from recorder.storage.recover import read_origin, recover

log = structlog.get_logger()

DAMAGED = ".damaged"
"""Ending of an orphan that was recovered in part only; it is retained like a recording."""


def find_orphans(names: FileNames) -> list[Path]:
    """Find files left by crashed recorders, and delete their unfinished copies.

    Raises:
        InputError: the named file is being written by another recorder.
    """
    orphans = []
    for part in sorted(names.folder.glob(f"*{PART}")):
        name = part.name.removesuffix(PART)
        if names.owns(name):
            if not is_locked(part):
                orphans.append(part)
            elif not names.dated:
                raise InputError(f"recording {part.with_name(name)}: {part} is being written by another recorder")
    for copy in names.folder.glob(f".{names.stem}*.tmp{PART}"):
        if not is_locked(copy):
            copy.unlink(missing_ok=True)
    return orphans


def list_damaged(names: FileNames) -> list[Path]:
    """Orphans that were recovered in part only."""
    ending = PART + DAMAGED
    return [path for path in names.folder.glob(f"*{ending}") if names.owns(path.name.removesuffix(ending))]


def repair(part: Path) -> None:
    """Recover an orphan, which is deleted only if nothing but its end is missing."""
    with lock_orphan(part):
        path = part.with_name(part.name.removesuffix(PART))
        if path.exists() and not _is_recovered_from(path, part):
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
        if saved.is_only_truncated:
            part.unlink()
        else:
            part.rename(part.with_name(part.name + DAMAGED))
        log.info("recovered", file=str(path), messages=saved.messages, lost=saved.losses)


def _is_empty(part: Path) -> bool:
    """True if an orphan has no message."""
    try:
        scan = Scan(part)
        return not any(True for _ in scan) and not scan.orphans and all(damage.is_end for damage in scan.damages)
    except InputError:
        return part.stat().st_size == 0


def _is_recovered_from(path: Path, part: Path) -> bool:
    """True if `path` was recovered from `part` by a recorder that crashed before it deleted `part`."""
    try:
        return read_origin(path) == read_origin(part) != {}
    except InputError:
        return False
