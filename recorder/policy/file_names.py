"""Names of the files of one recorder. Pure.

In a folder, each file is named after the plant and its start time: `cstr-20260701T100005Z.mcap`. With a file name
given, the first file has that name and the others are numbered: `run.mcap`, `run-2.mcap`.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

ENDING = ".mcap"
_MOMENT = "%Y%m%dT%H%M%SZ"
_MOMENT_PATTERN = r"-\d{8}T\d{6}Z"


@dataclass(frozen=True)
class FileNames:
    """Naming scheme of the files of one recorder.

    Attributes:
        folder: folder of the files.
        stem: start of each name.
        dated: True if the start time follows the stem.
    """

    folder: Path
    stem: str
    dated: bool

    @classmethod
    def of(cls, out: Path, plant: str, *, is_folder: bool) -> "FileNames":
        """Naming scheme of the setting `out`: a file, by its ending, or a folder.

        Args:
            out: the setting.
            plant: name of the plant, for files in a folder.
            is_folder: True if a folder of that name exists.
        """
        if out.suffix == ENDING and not is_folder:
            return cls(out.parent, out.stem, dated=False)
        return cls(out, plant, dated=True)

    def first(self, now: datetime) -> Path:
        """Name of a first file that is started at `now`."""
        return self.folder / f"{self._stem(now)}{ENDING}"

    def next(self, now_ns: int, existing: Iterable[str]) -> Path:
        """Name of the next file, with a number above all that exist, so that no name of a deleted file is reused.

        Args:
            now_ns: start time of the file.
            existing: names of files in the folder.
        """
        stem = self._stem(datetime.fromtimestamp(now_ns // 1_000_000_000, UTC))
        pattern = re.compile(rf"{re.escape(stem)}(?:-([1-9]\d*))?{re.escape(ENDING)}")
        matches = map(pattern.fullmatch, existing)
        last = max((int(match[1] or 1) for match in matches if match), default=0)
        return self.folder / (f"{stem}-{last + 1}{ENDING}" if last else f"{stem}{ENDING}")

    def owns(self, name: str) -> bool:
        """True if the scheme gives this name."""
        moment = _MOMENT_PATTERN if self.dated else ""
        return re.fullmatch(rf"{re.escape(self.stem)}{moment}(-[1-9]\d*)?{re.escape(ENDING)}", name) is not None

    def _stem(self, now: datetime) -> str:
        return f"{self.stem}-{now.astimezone(UTC):{_MOMENT}}" if self.dated else self.stem
