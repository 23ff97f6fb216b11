"""Files of the black box: names and time spans.

A killed recorder may leave an interval that was never copied. The next start finds it: its alarms are in the recordings
and in no file of the black box.
"""

from datetime import UTC, datetime
from pathlib import Path

from reactorwatch.errors import InputError
from recorder.policy.black_box import AlarmInterval
from recorder.policy.file_names import ENDING, FileNames
from recorder.storage.mcap_chunks import read_summary, span_ns
from recorder.storage.part_file import PART, is_locked

BLACK_BOX = "black-box"
"""Folder of the copied intervals, beside the recordings."""


class BlackBoxFiles:
    """Folder of one recorder's black box.

    Args:
        names: names of its recordings.
    """

    def __init__(self, names: FileNames) -> None:
        self._folder = names.folder / BLACK_BOX
        self._stem = names.stem

    def new(self, interval: AlarmInterval) -> Path:
        """Unused path for an interval; its folder is created."""
        self._folder.mkdir(exist_ok=True)
        raised = datetime.fromtimestamp(interval.raised_ns / 1e9, UTC)
        name = f"{self._stem}-{raised:%Y%m%dT%H%M%SZ}-{interval.alarm.replace('/', '-')}"
        path, count = self._folder / f"{name}{ENDING}", 1
        while path.exists():
            count += 1
            path = self._folder / f"{name}-{count}{ENDING}"
        return path

    def spans(self) -> list[tuple[int, int]]:
        """First and last time of receipt of each file; damaged files are skipped."""
        spans = []
        for path in self._folder.glob(f"{self._stem}-*{ENDING}"):
            try:
                spans.append(span_ns(read_summary(path)))
            except InputError:
                continue
        return spans

    def partial_copies(self) -> list[Path]:
        """Unfinished copies of a killed recorder."""
        return [copy for copy in self._folder.glob(f".{self._stem}-*.tmp{PART}") if not is_locked(copy)]
