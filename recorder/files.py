"""The files of a recorder: the one that it writes, and those that it has written or found (see `remains`).

What is written, and when a file is flushed or a new one begun, is decided elsewhere (`filing`, `head`, `black_box`,
`retention`); here it is done.
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
from reactorwatch.errors import InputError
from reactorwatch.runtime.delivery.reorder_buffer import Gap
from recorder.core import Kept, fingerprint
from recorder.message import Entry
from recorder.policy.black_box import BlackBox, Stretch
from recorder.policy.retention import Finished, Limits, to_delete
from recorder.policy.series import Series
from recorder.storage.ages import Ages, BootClock, read_boot_clock
from recorder.storage.background import Chores
from recorder.storage.black_box_files import BlackBoxFiles
from recorder.storage.gaps import GAP, to_metadata
from recorder.storage.mcap_scan import Scan, Stored, Wanted
from recorder.storage.mcap_writer import NUMBER, RecordingWriter, check_free, part_of
from recorder.storage.orphans import damaged, make_whole, remains_of
from recorder.storage.part_file import PART, PartFile
from recorder.tools.cut import cut, received_between

log = structlog.get_logger()


class RecordingFiles:
    """What `RecorderNode` writes to. As a context, it is closed on every way out.

    Args:
        series: the names of the files.
        metadata: what each of them says about its origin.
        limits: of what is kept.
        synced: whether a file that is complete is synced.
        open_part: what opens the file that is written to.
        read_clock: reads the clock since the machine's start, by which recordings are old.

    Raises:
        InputError: there is no such folder; the file that was asked for by name exists, or is being written.
    """

    def __init__(
        self,
        series: Series,
        metadata: Mapping[str, str],
        limits: Limits = Limits(),  # noqa: B008 (it is frozen)
        *,
        synced: bool = False,
        open_part: Callable[[Path], PartFile] = PartFile,
        read_clock: Callable[[], BootClock] = read_boot_clock,
    ) -> None:
        self._series = series
        self._metadata = metadata
        self._limits = limits
        self._synced = synced
        self._open_part = open_part
        self._writer: RecordingWriter | None = None
        self._black_boxes = BlackBoxFiles(series)
        self._chores = Chores()
        self._begun = 0
        self._before = ""
        self._last_ns = 0
        self._abandoned: list[Path] = []
        first = series.first(datetime.now(UTC))
        self._left = [] if not series.folder.is_dir() else remains_of(series)
        for copy in self._black_boxes.half_made():
            copy.unlink(missing_ok=True)
        if not self._left:
            check_free(first)
        self._ages = Ages(series.folder / f".{series.stem}.ages", read_clock)
        self._ages.see((path.name, path.stat().st_mtime_ns) for path in self._kept_for_a_time())

    @property
    def path(self) -> Path | None:
        """The name that the file being written will have; None if there is none."""
        return self._writer.path if self._writer is not None else None

    @property
    def size_bytes(self) -> int:
        """Of the file that is being written."""
        return self._writer.size_bytes if self._writer is not None else 0

    def recover_left_behind(self) -> None:
        """Have what a killed recorder left behind made whole, while recording goes on."""
        for part in self._left:
            self._chores.add(f"recovering {part}", partial(make_whole, part))
        self._left = []

    def begin(self, head: Iterable[Entry], now_ns: int) -> Path:
        """Begin a file, after the one before is complete.

        Args:
            head: what it says first.
            now_ns: what it may be named after.

        Raises:
            InputError: a file cannot be written; see `abandon`.
        """
        self.complete()
        folder = self._series.folder
        try:
            if self._begun:
                folder.mkdir(parents=True, exist_ok=True)  # it may have been deleted since
            there = {path.name.removesuffix(PART) for path in folder.iterdir()}
        except OSError as error:
            raise InputError(f"folder {folder}: cannot be written to: {error.strerror}") from error
        path = self._series.next(now_ns, there)
        started = datetime.fromtimestamp(now_ns / 1e9, UTC).isoformat(timespec="milliseconds")
        about = {**self._metadata, "started": started, NUMBER: str(self._begun + 1)}
        if self._before:
            about["after"] = self._before
        self._writer = RecordingWriter(path, about, self._open_part)
        self._begun += 1
        self._before = path.name
        for entry in head:
            self._writer.write(entry)
        log.info("recording", file=str(path))
        for part in self._abandoned:
            self._chores.add(f"recovering {part}", partial(make_whole, part))
        self._abandoned = []
        return path

    def write(self, kept: Kept) -> None:
        """Append a message.

        Raises:
            WriteError: the file cannot be written; see `abandon`.
        """
        assert self._writer is not None, "a file was begun"
        self._writer.write(kept.entry, readable=kept.readable)
        self._last_ns = kept.entry.log_time_ns

    def write_gap(self, gap: Gap) -> None:
        """Write that something was lost on the way.

        Raises:
            WriteError: the file cannot be written; see `abandon`.
        """
        assert self._writer is not None, "a file was begun"
        self._writer.add_metadata(GAP, to_metadata(gap))
        log.warning("lost on the way", stream=gap.stream, messages=gap.messages)

    def received_since(self, from_ns: int) -> set[int]:
        """Fingerprints of what the files that are there received since a moment, complete or left behind."""
        return {fingerprint(stored.channel.topic, stored.payload) for stored in self._stored_since(from_ns)}

    def missed_stretches(self, black_box: BlackBox, now_ns: int) -> list[Stretch]:
        """Have a black box go on where that of a killed recorder was, before what it left behind is recovered.

        Returns:
            The stretches that are over and were never kept.
        """
        kept = self._black_boxes.spans()
        over = []
        for stored in self._stored_since(now_ns - black_box.reach_ns, is_alarm) if black_box.reach_ns else ():
            at_ns = stored.log_time_ns
            if any(first_ns <= at_ns <= last_ns for first_ns, last_ns in kept):
                continue
            try:
                over.append(black_box.on_message(decode(stored.payload, stored.entry.encoding), at_ns))
            except DecodeError:
                continue
        over.append(black_box.over(now_ns))
        return [stretch for stretch in over if stretch is not None]

    def _stored_since(self, from_ns: int, wanted: Wanted | None = None) -> Iterator[Stored]:
        """What the files that are there received since a moment; one file after the other, the oldest first."""
        there = [(path.stat().st_mtime_ns, path) for path in (*self._finished(), *self._left)]
        for _, path in sorted(item for item in there if item[0] >= from_ns):
            try:
                scan = Scan(path, from_ns=from_ns, wanted=wanted)
            except InputError:
                continue  # nothing is in it
            yield from (stored for stored in scan if stored.log_time_ns >= from_ns and not stored.repeated)

    def flush(self) -> None:
        """Hand over what was written; see `RecordingWriter.flush`."""
        if self._writer is not None:
            self._writer.flush()

    def sync(self) -> None:
        """Wait for the disk; see `RecordingWriter.sync`."""
        if self._writer is not None:
            self._writer.sync()

    def complete(self) -> None:
        """Make the file whole that is being written.

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
            self._ages.note(self._writer.path.name, self._writer.path.stat().st_mtime_ns)
        log.info("recorded", file=str(self._writer.path))
        self._writer = None

    def abandon(self) -> None:
        """Leave the file as it was last flushed; it is recovered as soon as another one was begun."""
        if self._writer is None:
            return
        self._writer.abandon()
        part = part_of(self._writer.path)
        if part.exists():
            self._abandoned.append(part)
        self._writer = None

    def free_bytes(self) -> int:
        """The room that is left on the disk; of a folder that was deleted, where it would be made again."""
        folder = self._series.folder.absolute()
        there = next(path for path in (folder, *folder.parents) if path.is_dir())
        return shutil.disk_usage(there).free

    def keep_for_good(self, stretch: Stretch) -> None:
        """Have a stretch of time copied into a file of its own; flush before."""
        self._chores.add(f"the black box of {stretch.alarm}", lambda: self._black_box(stretch))

    def delete_oldest(self, needed_ns: int | None) -> None:
        """Have what is beyond the limits deleted.

        Args:
            needed_ns: what ended in this last span of time stays; None: nothing is needed.
        """
        if self._limits != Limits():
            now_ns = self._ages.now_ns()
            self._chores.add("deleting old recordings", lambda: self._delete_oldest(now_ns, needed_ns))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.complete()
        finally:
            self._chores.finish()

    def _finished(self) -> list[Path]:
        if not self._series.folder.is_dir():
            return []
        return [path for path in self._series.folder.iterdir() if self._series.owns(path.name) and path.is_file()]

    def _kept_for_a_time(self) -> list[Path]:
        """The files that the limits are of: recordings, and remains from which not all could be recovered."""
        return [*self._finished(), *damaged(self._series)]

    def _black_box(self, stretch: Stretch) -> None:
        path = self._black_boxes.new(stretch)
        raised = datetime.fromtimestamp(stretch.raised_ns / 1e9, UTC)
        about = {**self._metadata, "alarm": stretch.alarm, "raised": raised.isoformat(timespec="milliseconds")}
        window = received_between(stretch.from_ns, stretch.to_ns)
        while True:
            writing = self.path
            sources = [source for source in self._finished() if source.stat().st_mtime_ns >= stretch.from_ns]
            if writing is not None and writing not in sources:
                sources.append(part_of(writing))
            try:
                count = cut(sources, path, window, about, tolerant=True)
                break
            except InputError:
                if all(source.exists() for source in sources):
                    raise  # else the file being written has got its name meanwhile
        log.info("black box", file=str(path), alarm=stretch.alarm, messages=count)

    def _delete_oldest(self, now_ns: int, needed_ns: int | None) -> None:
        writer = self._writer  # before the others are listed: what it writes may become one of them
        there = [path for path in self._kept_for_a_time() if writer is None or path != writer.path]
        stats = [(path, path.stat()) for path in there]
        seen_ns = self._ages.see((path.name, stat.st_mtime_ns) for path, stat in stats)
        finished = [Finished(path, stat.st_size, seen_ns[path.name], stat.st_mtime_ns) for path, stat in stats]
        writing_bytes = writer.size_bytes if writer is not None else None
        needed_since_ns = None if needed_ns is None else now_ns - needed_ns
        for path in to_delete(finished, writing_bytes, self._limits, now_ns, needed_since_ns):
            path.unlink()
            log.info("deleted", file=str(path), why="the limits of what is kept")
        self._ages.store()


def is_alarm(topic: str) -> bool:
    """Whether a topic is that of an alarm."""
    parsed = keys.parse(topic)
    return parsed is not None and parsed.kind == keys.ALARM
