"""Files of a recorder: the one being written, complete ones, and those left by a crashed recorder.

The decisions when to flush, rotate, copy and delete are made in `recorder.keep`; this module carries them out.

A wall clock may be wrong at boot and may be set by years; that must not delete a recording. So the age of a recording
is the time confirmed by the clock since boot: the time in which the machine ran, with or without a recorder. It counts
from the time at which a recorder completed or found the file. A small file beside the recordings carries it over a
restart.
"""

import contextlib
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import msgspec
import structlog
import tomli_w

from reactorwatch.contract import keys
from reactorwatch.description.read import PlantProcesses
from reactorwatch.errors import InputError
from reactorwatch.limits import parse_json
from reactorwatch.records.write import atomic_write, make_folder
from reactorwatch.runtime.reorder_buffer import Gap
from recorder import RecordedMessage, StoredMessage
from recorder.config import MB, RecorderConfig
from recorder.core import ReceivedMessage, fingerprint
from recorder.files.copies import Window, cut, delete_partial_copies, find_orphans, list_damaged, repair
from recorder.files.index import span_ns
from recorder.files.reader import Reader, Wanted, select_topics
from recorder.files.recording import FILE_INDEX, GAP, PROCESS, gap_metadata, process_metadata
from recorder.files.writer import PART, PartFile, RecordingWriter, check_free, part_of
from recorder.keep import (
    DAY_NS,
    ENDING,
    AlarmInterval,
    BlackBox,
    CompleteRecording,
    FileNames,
    Limits,
    select_deletions,
)
from recorder.samples import content_of

log = structlog.get_logger()

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class BootClock(NamedTuple):
    """Reading of the clock since boot; without an identifier of the boot, those of two processes are not compared."""

    boot: str
    since_ns: int


def read_boot_clock() -> BootClock:
    """Read the clock since boot."""
    try:
        boot = _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return BootClock("", time.monotonic_ns())
    return BootClock(boot, time.clock_gettime_ns(time.CLOCK_BOOTTIME))


class _FirstSeen(msgspec.Struct, frozen=True):
    modified_ns: int  # a reused name with another modification time is another file
    seen_ns: int


class _StoredAges(msgspec.Struct, frozen=True):
    boot: str
    since_ns: int
    now_ns: int
    seen: dict[str, _FirstSeen]


class Ages:
    """Confirmed times at which recordings were first seen complete, stored in a file."""

    def __init__(self, path: Path, read_clock: Callable[[], BootClock] = read_boot_clock) -> None:
        self._path = path
        self._read_clock = read_clock
        self._start = read_clock()
        self._start_ns = 0
        self._seen: dict[str, _FirstSeen] = {}
        self._noted: dict[str, _FirstSeen] = {}
        try:
            stored = msgspec.convert(parse_json(path.read_bytes()), _StoredAges)
        except FileNotFoundError:
            return
        except (OSError, InputError, msgspec.ValidationError) as error:
            log.warning("ages of recordings count from now", file=str(path), why=str(error))
            return
        same = stored.boot == self._start.boot != "" and stored.since_ns <= self._start.since_ns
        self._start_ns = stored.now_ns + (self._start.since_ns - stored.since_ns if same else 0)
        self._seen = stored.seen

    def now_ns(self) -> int:
        """Confirmed time."""
        return self._start_ns + self._read_clock().since_ns - self._start.since_ns

    def add(self, name: str, modified_ns: int) -> None:
        """Add a recording that was completed now; thread-safe."""
        self._noted[name] = _FirstSeen(modified_ns, self.now_ns())

    def update(self, modified_ns: Iterable[tuple[str, int]]) -> dict[str, int]:
        """Replace the existing recordings and their modification times; returns when each was first seen, by name."""
        now_ns = self.now_ns()
        before, self._seen = self._seen, {}
        for name, modified in modified_ns:
            seen = self._noted.pop(name, before.get(name))
            if seen is None or seen.modified_ns != modified:
                seen = _FirstSeen(modified, now_ns)
            self._seen[name] = seen
        return {name: seen.seen_ns for name, seen in self._seen.items()}

    def store(self) -> None:
        """Write the file, so that the next recorder resumes from it."""
        since_ns = self._read_clock().since_ns
        now_ns = self._start_ns + since_ns - self._start.since_ns
        stored = _StoredAges(self._start.boot, since_ns, now_ns, self._seen)
        with atomic_write(self._path) as temporary:
            temporary.write_bytes(msgspec.json.encode(stored))


BLACK_BOX = "black-box"
"""Folder of the copied intervals, beside the recordings."""


class RecordingFiles:
    """Files that `RecorderNode` writes to; as a context manager, it is closed in every case.

    Args:
        config: the settings; a folder that they name is made if it does not exist.
        open_part: opens the file that is written to.
        read_clock: reads the time since boot, which ages the recordings.

    Raises:
        InputError: the folder does not exist or cannot be made, or the named file exists or is being written.
    """

    def __init__(
        self,
        config: RecorderConfig,
        open_part: Callable[[Path], PartFile] = PartFile,
        read_clock: Callable[[], BootClock] = read_boot_clock,
    ) -> None:
        names = self._names = file_names(config)
        # run.csv is a file of another kind, not a folder's name
        if names.dated and not names.folder.suffix[1:].isalpha():
            make_folder(names.folder, "--out")
        self._metadata = {
            "plant": config.plant,
            "key_expression": config.key_expression,
            "configuration": tomli_w.dumps(msgspec.to_builtins(config)),
            **config.about,
        }
        self._limits = Limits(config.keep_mb * MB, config.keep_days * DAY_NS, config.keep_files)
        self._synced, self._open_part = config.fsync != "never", open_part
        self._find_process = PlantProcesses(config.processes).find
        self._plants: set[str] = set()  # with samples in the current file
        self._writer: RecordingWriter | None = None
        self._black_boxes = names.folder / BLACK_BOX
        self._tasks = ThreadPoolExecutor(1, "background tasks")  # slow work on files, in its order
        self._file_count = 0
        self._previous = ""
        self._last_ns = 0
        self._orphans = [] if not names.folder.is_dir() else find_orphans(names)  # repaired once a file is started
        delete_partial_copies(self._black_boxes, f"{names.stem}-")
        if not self._orphans:
            check_free(names.next(time.time_ns()))
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

    @property
    def free_bytes(self) -> int:
        """Free space on the disk of the folder."""
        return free_bytes(self._names.folder)

    def start_file(self, latched: Iterable[RecordedMessage], now_ns: int) -> Path:
        """Complete the current file and start the next one; orphans are repaired in the background.

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
        self._plants = set()
        self._file_count += 1
        self._previous = path.name
        for entry in latched:
            self._writer.write(entry)
        log.info("recording", file=str(path))
        for part in self._orphans:
            self._submit(f"recovering {part}", partial(repair, part))
        self._orphans = []
        return path

    def write(self, received: ReceivedMessage) -> None:
        """Append a message.

        Raises:
            WriteError: the file cannot be written; see `abandon`.
        """
        assert self._writer is not None, "a file was started"
        if not self._writer.has(received.channel):
            self._describe_plant(received.channel.key)
        self._writer.append(received)
        self._last_ns = received.log_time_ns

    def _describe_plant(self, key: str) -> None:
        """Describe the process of a plant at the first of its samples in the file."""
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
        self._writer.add_metadata(GAP, gap_metadata(gap))
        log.warning("lost on the way", stream=gap.stream, messages=gap.messages)

    def fingerprints_since(self, from_ns: int) -> set[int]:
        """Fingerprints of messages received since `from_ns`, in complete and in orphaned files."""
        return {fingerprint(stored.channel.key, stored.payload) for stored in self._messages_since(from_ns)}

    def find_missed_intervals(self, black_box: BlackBox, now_ns: int) -> list[AlarmInterval]:
        """Restore a black box from recorded alarms, before orphans are recovered.

        Returns:
            The intervals that have ended and were never copied.
        """
        saved = self._black_box_spans()
        ended = []
        alarms = select_topics({keys.ALARM})
        for stored in self._messages_since(now_ns - black_box.longest_ns, alarms) if black_box.longest_ns else ():
            at_ns = stored.log_time_ns
            if any(first_ns <= at_ns <= last_ns for first_ns, last_ns in saved):
                continue
            if (content := content_of(stored.recorded_message)) is not None:
                ended.append(black_box.on_message(content, at_ns))
        ended.append(black_box.pop_ended(now_ns))
        return [interval for interval in ended if interval is not None]

    def _messages_since(self, from_ns: int, wanted: Wanted | None = None) -> Iterator[StoredMessage]:
        """Messages received since `from_ns`, file by file, the oldest first."""
        files = [(path.stat().st_mtime_ns, path) for path in (*self._complete_files(), *self._orphans)]
        for _, path in sorted(item for item in files if item[0] >= from_ns):
            try:
                reader = Reader(path, from_ns=from_ns, wanted=wanted, tolerant=True)
            except InputError:
                continue  # it is empty
            yield from (stored for stored in reader if stored.log_time_ns >= from_ns and not stored.channel.latched)

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
            self._orphans.append(part)
        self._writer = None
        return saved

    def save_black_box(self, interval: AlarmInterval) -> None:
        """Copy an interval into a file of its own, in the background; flush before."""
        self._submit(f"the black box of {interval.alarm}", lambda: self._copy_black_box(interval))

    def delete_oldest(self, protected_ns: int | None) -> None:
        """Delete recordings beyond the limits, in the background.

        Args:
            protected_ns: recordings that ended within this time stay; None protects none.
        """
        if self._limits != Limits():
            now_ns = self._ages.now_ns()
            self._submit("deleting old recordings", lambda: self._delete_oldest(now_ns, protected_ns))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.complete()
        finally:
            self._tasks.shutdown()

    def _submit(self, name: str, task: Callable[[], None]) -> None:
        """Queue a task in the background; one that fails is logged by its name and never ends the recording."""

        def work() -> None:
            try:
                task()
            except (InputError, OSError) as error:
                log.warning(f"{name} failed", why=str(error))

        self._tasks.submit(work).add_done_callback(Future.result)  # it logs an error that is a fault of this software

    def _complete_files(self) -> list[Path]:
        if not self._names.folder.is_dir():
            return []
        return [path for path in self._names.folder.iterdir() if self._names.owns(path.name) and path.is_file()]

    def _deletable(self) -> list[Path]:
        """Files that the limits apply to: complete recordings and damaged orphans."""
        return [*self._complete_files(), *list_damaged(self._names)]

    def _copy_black_box(self, interval: AlarmInterval) -> None:
        raised = datetime.fromtimestamp(interval.raised_ns / 1e9, UTC)
        self._black_boxes.mkdir(exist_ok=True)
        name = f"{self._names.stem}-{raised:%Y%m%dT%H%M%SZ}-{interval.alarm.replace('/', '-')}"
        path, number = self._black_boxes / f"{name}{ENDING}", 1
        while path.exists():
            number += 1
            path = self._black_boxes / f"{name}-{number}{ENDING}"
        metadata = {**self._metadata, "alarm": interval.alarm, "raised": raised.isoformat(timespec="milliseconds")}
        window = Window((interval.from_ns, interval.to_ns))
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

    def _black_box_spans(self) -> list[tuple[int, int]]:
        """First and last time of receipt of each saved interval; damaged files are skipped.

        A killed recorder may leave an interval that was never copied: its alarms are in none of these.
        """
        spans = []
        for path in self._black_boxes.glob(f"{self._names.stem}-*{ENDING}"):
            with contextlib.suppress(InputError):
                spans.append(span_ns(Reader(path).summary))
        return spans

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


def file_names(config: RecorderConfig) -> FileNames:
    """File names of the settings."""
    out = Path(config.out)
    return FileNames.of(out, config.plant, is_folder=out.is_dir())


def free_bytes(folder: Path) -> int:
    """Free space on the disk of a folder, which may have been deleted."""
    folder = folder.absolute()
    return shutil.disk_usage(next(path for path in (folder, *folder.parents) if path.is_dir())).free
