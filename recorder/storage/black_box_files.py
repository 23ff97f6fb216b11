"""The files of the black box: what they are called, and which moments they hold.

A recorder that is killed leaves a stretch undone: it was not over, or was being copied. The next start finds out by
the alarms in the recordings that no file of the black box holds.
"""

from datetime import UTC, datetime
from pathlib import Path

from reactorwatch.errors import InputError
from recorder.policy.black_box import Stretch
from recorder.policy.series import ENDING, Series
from recorder.storage.mcap_chunks import read_summary, span_ns
from recorder.storage.part_file import PART, is_held

BLACK_BOX = "black-box"
"""The folder, beside the recordings, of the stretches that are kept for good."""


class BlackBoxFiles:
    """The folder of one recorder's black box.

    Args:
        series: the names of its recordings.
    """

    def __init__(self, series: Series) -> None:
        self._folder = series.folder / BLACK_BOX
        self._stem = series.stem

    def new(self, stretch: Stretch) -> Path:
        """A name for a stretch that nobody has; its folder is there then."""
        self._folder.mkdir(exist_ok=True)
        raised = datetime.fromtimestamp(stretch.raised_ns / 1e9, UTC)
        name = f"{self._stem}-{raised:%Y%m%dT%H%M%SZ}-{stretch.alarm.replace('/', '-')}"
        path, number = self._folder / f"{name}{ENDING}", 1
        while path.exists():
            number += 1
            path = self._folder / f"{name}-{number}{ENDING}"
        return path

    def spans(self) -> list[tuple[int, int]]:
        """From when to when each of them goes, in times of receipt; those that are damaged hold nothing."""
        found = []
        for path in self._folder.glob(f"{self._stem}-*{ENDING}"):
            try:
                found.append(span_ns(read_summary(path)))
            except InputError:
                continue
        return found

    def half_made(self) -> list[Path]:
        """Copies that a kill left half made."""
        return [copy for copy in self._folder.glob(f".{self._stem}-*.tmp{PART}") if not is_held(copy)]
