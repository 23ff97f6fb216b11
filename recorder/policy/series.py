"""What the files of one recorder are called. Pure.

With a folder to write to, each file has the plant's name and the moment of its beginning: `cstr-20260701T100005Z.mcap`.
With a file, the first has its name and the others are counted: `run.mcap`, `run-2.mcap`.
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
class Series:
    """The names that belong together.

    Attributes:
        folder: where the files are.
        stem: what their names begin with.
        dated: whether the moment follows.
    """

    folder: Path
    stem: str
    dated: bool

    @classmethod
    def of(cls, out: Path, plant: str, *, is_folder: bool) -> "Series":
        """The series that a setting names: a file, by its ending, or a folder.

        Args:
            out: the setting.
            plant: what files in a folder are named after.
            is_folder: whether there is a folder of that name.
        """
        if out.suffix == ENDING and not is_folder:
            return cls(out.parent, out.stem, dated=False)
        return cls(out, plant, dated=True)

    def first(self, now: datetime) -> Path:
        """The name of a file begun at a moment, if nobody has it."""
        return self.folder / f"{self._stem(now)}{ENDING}"

    def next(self, now_ns: int, there: Iterable[str]) -> Path:
        """The name of the next file: its number is higher than any that is there, also if earlier ones are gone.

        Args:
            now_ns: the moment of its beginning.
            there: names of files in the folder.
        """
        stem = self._stem(datetime.fromtimestamp(now_ns // 1_000_000_000, UTC))
        pattern = re.compile(rf"{re.escape(stem)}(?:-([1-9]\d*))?{re.escape(ENDING)}")
        matches = map(pattern.fullmatch, there)
        last = max((int(match[1] or 1) for match in matches if match), default=0)
        return self.folder / (f"{stem}-{last + 1}{ENDING}" if last else f"{stem}{ENDING}")

    def owns(self, name: str) -> bool:
        """Whether a name is one of these."""
        moment = _MOMENT_PATTERN if self.dated else ""
        return re.fullmatch(rf"{re.escape(self.stem)}{moment}(-[1-9]\d*)?{re.escape(ENDING)}", name) is not None

    def _stem(self, now: datetime) -> str:
        return f"{self.stem}-{now.astimezone(UTC):{_MOMENT}}" if self.dated else self.stem
