"""Files of a recorder: the one being written, complete ones, and those left by a crashed recorder (see `orphans`).

The decisions when to flush, rotate, copy and delete are made in `recorder.policy`; this module carries them out.
"""

import contextlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import structlog

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, decode
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.runtime.delivery.reorder_buffer import Gap
from recorder.core import ReceivedMessage, fingerprint
from recorder.message import RecordedMessage
from recorder.policy.black_box import AlarmInterval, BlackBox
from recorder.policy.file_names import FileNames
from recorder.policy.retention import CompleteRecording, Limits, select_deletions
from recorder.storage.ages import Ages, BootClock, read_boot_clock
from recorder.storage.background import BackgroundTasks
from recorder.storage.black_box_files import BlackBoxFiles
from recorder.storage.crash_recovery import find_orphans, list_damaged, repair
from recorder.storage.gaps import GAP, to_metadata
from recorder.storage.mcap_scan import RawMessage, Scan, Wanted
from recorder.storage.mcap_writer import FILE_INDEX, RecordingWriter, check_free, part_of
from recorder.storage.part_file import PART, PartFile
from recorder.storage.process_metadata import PROCESS
from recorder.storage.process_metadata import to_metadata as process_metadata
from recorder.tools.cut import cut, receipt_window

log = structlog.get_logger()


class RecordingFiles:
    """Files that `RecorderNode` writes to; as a context manager, it is closed in every case.

    Args:
        names: names of the files.
        metadata: metadata of each file.
        limits: limits of retention.
        synced: True to sync each file when it is completed.
        open_part: opens the file that is written to.
        read_clock: reads the time since boot, which ages the recordings.
        find_process: returns the process of a plant, which each file with its samples describes; None: unknown.

    Raises:
        InputError: the folder does not exist, or the named file exists or is being written.
    """

    def __init__(
        self,
        names: FileNames,
        metadata: Mapping[str, str],
        limits: Limits = Limits(),  # noqa: B008 (it is frozen)
        *,
        synced: bool = False,
        open_part: Callable[[Path], PartFile] = PartFile,
        read_clock: Callable[[], BootClock] = read_boot_clock,
        find_process: Callable[[str], Process | None] = lambda _: None,
    ) -> None:
        self._find_process = find_process
        self._keys: set[str] = set()  # in the current file
        self._plants: set[str] = set()  # with samples in the current file
        self._names = names
        self._metadata = metadata
        self._limits = limits
        self._synced = synced
        self._open_part = open_part
        self._writer: RecordingWriter | None = None
        self._black_boxes = BlackBoxFiles(names)
        self._tasks = BackgroundTasks()
        self._file_count = 0
        self._previous = ""
        self._last_ns = 0
        self._abandoned: list[Path] = []
        first = names.first(datetime.now(UTC))
        self._orphans = [] if not names.folder.is_dir() else find_orphans(names)
        for copy in self._black_boxes.partial_copies():
            copy.unlink(missing_ok=True)
        if not self._orphans:
            check_free(first)
        self._ages = Ages(names.folder / f".{names.stem}.ages", read_clock)
        self._ages.update((path.name, path.stat().st_mtime_ns) for path in self._deletable())

    @property
    def path(self) -> Path | None:
        """Final name of the file being written; None if there is none."""
        return self._writer.path if self._writer is not None else None

    @property
    def size_bytes(self) -> int:
        """Size of the file being written; 0 if there is none."""
        return self._writer.size_bytes if self._writer is not None else 0

    def recover_orphans(self) -> None:
        """Repair files of a crashed recorder in the background."""
        for part in self._orphans:
            self._tasks.submit(f"recovering {part}", partial(repair, part))
        self._orphans = []

    def start_file(self, latched: Iterable[RecordedMessage], now_ns: int) -> Path:
        """Complete the current file and start the next one.

        Args:
            latched: messages to repeat at its start.
            now_ns: start time, for its name.

        Raises:
            InputError: a file cannot be written; see `abandon`.
        """
        self.complete()
        folder = self._names.folder
        try:
            if self._file_count:
                folder.mkdir(parents=True, exist_ok=True)  # it may have been deleted since
            existing = {path.name.removesuffix(PART) for path in folder.iterdir()}
        except OSError as error:
            raise InputError(f"folder {folder}: cannot be written to: {error.strerror}") from error
        path = self._names.next(now_ns, existing)
        started = datetime.fromtimestamp(now_ns / 1e9, UTC).isoformat(timespec="milliseconds")
        metadata = {**self._metadata, "started": started, FILE_INDEX: str(self._file_count + 1)}
        if self._previous:
            metadata["after"] = self._previous
        self._writer = RecordingWriter(path, metadata, self._open_part)
        self._keys, self._plants = set(), set()
        self._file_count += 1
        self._previous = path.name
        for entry in latched:
            self._writer.write(entry)
        log.info("recording", file=str(path))
        for part in self._abandoned:
            self._tasks.submit(f"recovering {part}", partial(repair, part))
        self._abandoned = []
        return path

    def write(self, received: ReceivedMessage) -> None:
        """Append a message.

        Raises:
            WriteError: the file cannot be written; see `abandon`.
        """
        assert self._writer is not None, "a file was started"
        recorded = received.recorded
        if recorded.key not in self._keys:
            self._describe_plant(recorded.key)
        self._writer.write(recorded, readable=received.message is not None, sequence=received.sequence)
        self._last_ns = recorded.log_time_ns

    def _describe_plant(self, key: str) -> None:
        """Describe the process of a plant at the first of its samples in the file."""
        self._keys.add(key)
        topic = keys.parse(key)
        if topic is None or topic.kind != keys.SAMPLE or topic.plant in self._plants:
            return
        self._plants.add(topic.plant)
        process = self._find_process(topic.plant)
        if process is not None and self._writer is not None:
            self._writer.add_metadata(PROCESS, process_metadata(topic.plant, process))

    def write_gap(self, gap: Gap) -> None:
        """Record a gap in the messages of the bus.

        Raises:
            WriteError: the file cannot be written; see `abandon`.
        """
        assert self._writer is not None, "a file was started"
        self._writer.add_metadata(GAP, to_metadata(gap))
        log.warning("lost on the way", stream=gap.stream, messages=gap.messages)

    def fingerprints_since(self, from_ns: int) -> set[int]:
        """Fingerprints of messages received since `from_ns`, in complete and in orphaned files."""
        return {fingerprint(stored.channel.topic, stored.payload) for stored in self._messages_since(from_ns)}

    def find_missed_intervals(self, black_box: BlackBox, now_ns: int) -> list[AlarmInterval]:
        """Restore a black box from recorded alarms, before orphans are recovered.

        Returns:
            The intervals that have ended and were never copied.
        """
        saved = self._black_boxes.spans()
        ended = []
        for stored in self._messages_since(now_ns - black_box.longest_ns, is_alarm) if black_box.longest_ns else ():
            at_ns = stored.log_time_ns
            if any(first_ns <= at_ns <= last_ns for first_ns, last_ns in saved):
                continue
            try:
                ended.append(black_box.on_message(decode(stored.payload, stored.recorded_message.encoding), at_ns))
            except DecodeError:
                continue
        ended.append(black_box.pop_ended(now_ns))
        return [interval for interval in ended if interval is not None]

    def _messages_since(self, from_ns: int, wanted: Wanted | None = None) -> Iterator[RawMessage]:
        """Messages received since `from_ns`, file by file, the oldest first."""
        files = [(path.stat().st_mtime_ns, path) for path in (*self._complete_files(), *self._orphans)]
        for _, path in sorted(item for item in files if item[0] >= from_ns):
            try:
                scan = Scan(path, from_ns=from_ns, wanted=wanted)
            except InputError:
                continue  # it is empty
            yield from (stored for stored in scan if stored.log_time_ns >= from_ns and not stored.latched)

    def flush(self) -> None:
        """Flush the file; see `RecordingWriter.flush`."""
        if self._writer is not None:
            self._writer.flush()

    def sync(self) -> None:
        """Sync the file; see `RecordingWriter.sync`."""
        if self._writer is not None:
            self._writer.sync()

    def complete(self) -> None:
        """Complete the file being written.

        Raises:
            WriteError: it cannot be written; see `abandon`.
        """
        if self._writer is None:
            return
        if self._synced:
            self._writer.flush()
            self._writer.sync()
        self._writer.close()
        with contextlib.suppress(FileNotFoundError):  # it was deleted at once
            if self._last_ns:
                os.utime(self._writer.path, ns=(self._last_ns, self._last_ns))
            self._ages.add(self._writer.path.name, self._writer.path.stat().st_mtime_ns)
        log.info("recorded", file=str(self._writer.path))
        self._writer = None

    def abandon(self) -> int:
        """Leave the file as it is; it is recovered after the next one is started.

        Returns:
            Count of the messages since the last flush that the recovery will find.
        """
        if self._writer is None:
            return 0
        saved = self._writer.abandon()
        part = part_of(self._writer.path)
        if part.exists():
            self._abandoned.append(part)
        self._writer = None
        return saved

    def free_bytes(self) -> int:
        """Free space on the disk of the folder, which may have been deleted."""
        folder = self._names.folder.absolute()
        return shutil.disk_usage(next(path for path in (folder, *folder.parents) if path.is_dir())).free

    def save_black_box(self, interval: AlarmInterval) -> None:
        """Copy an interval into a file of its own, in the background; flush before."""
        self._tasks.submit(f"the black box of {interval.alarm}", lambda: self._copy_black_box(interval))

    def delete_oldest(self, protected_ns: int | None) -> None:
        """Delete recordings beyond the limits, in the background.

        Args:
            protected_ns: recordings that ended within this time stay; None protects none.
        """
        if self._limits != Limits():
            now_ns = self._ages.now_ns()
            self._tasks.submit("deleting old recordings", lambda: self._delete_oldest(now_ns, protected_ns))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.complete()
        finally:
            self._tasks.finish()

    def _complete_files(self) -> list[Path]:
        if not self._names.folder.is_dir():
            return []
        return [path for path in self._names.folder.iterdir() if self._names.owns(path.name) and path.is_file()]

    def _deletable(self) -> list[Path]:
        """Files that the limits apply to: complete recordings and damaged orphans."""
        return [*self._complete_files(), *list_damaged(self._names)]

    def _copy_black_box(self, interval: AlarmInterval) -> None:
        path = self._black_boxes.new(interval)
        raised = datetime.fromtimestamp(interval.raised_ns / 1e9, UTC)
        metadata = {**self._metadata, "alarm": interval.alarm, "raised": raised.isoformat(timespec="milliseconds")}
        window = receipt_window(interval.from_ns, interval.to_ns)
        while True:
            writing = self.path
            sources = [source for source in self._complete_files() if source.stat().st_mtime_ns >= interval.from_ns]
            if writing is not None and writing not in sources:
                sources.append(part_of(writing))
            try:
                count = cut(sources, path, window, metadata, tolerant=True)
                break
            except InputError:
                if all(source.exists() for source in sources):
                    raise  # else the file being written was completed meanwhile
        log.info("black box", file=str(path), alarm=interval.alarm, messages=count)

    def _delete_oldest(self, now_ns: int, protected_ns: int | None) -> None:
        writer = self._writer  # before the others are listed: its file may become one of them
        paths = [path for path in self._deletable() if writer is None or path != writer.path]
        stats = [(path, path.stat()) for path in paths]
        seen_ns = self._ages.update((path.name, stat.st_mtime_ns) for path, stat in stats)
        complete = [CompleteRecording(path, stat.st_size, seen_ns[path.name], stat.st_mtime_ns) for path, stat in stats]
        writing_bytes = writer.size_bytes if writer is not None else None
        protected_since_ns = None if protected_ns is None else now_ns - protected_ns
        for path in select_deletions(complete, writing_bytes, self._limits, now_ns, protected_since_ns):
            path.unlink()
            log.info("deleted", file=str(path), why="the limits of what is kept")
        self._ages.store()


def is_alarm(topic: str) -> bool:
    """True for the topic of an alarm."""
    parsed = keys.parse(topic)
    return parsed is not None and parsed.kind == keys.ALARM
