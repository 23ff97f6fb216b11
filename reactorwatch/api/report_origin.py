"""Origin of a report: when, by which version, from which file and with which settings it was made."""

import hashlib
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from reactorwatch.version import this_build


def report_origin(file: Path, settings: Mapping[str, object]) -> dict[str, str]:
    """Origin of a report, by name.

    Args:
        file: the file that was read, or a folder of recordings.
        settings: what was chosen; empty values are left out.
    """
    chosen = ", ".join(f"{name} {_format(value)}" for name, value in settings.items() if value)
    parts = {
        "made": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S %z"),
        "software": f"reactorwatch {this_build()}",
        "file": str(file),
        "SHA-256 of the file": file_hash(file) if file.is_file() else "",
        "settings": chosen or "default",
    }
    return {name: text for name, text in parts.items() if text}


def file_hash(file: Path) -> str:
    """SHA-256 of a file as hexadecimal digits."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _format(value: object) -> str:
    if isinstance(value, dict):
        return " ".join(f"{name}={item}" for name, item in value.items())
    return str(value)
