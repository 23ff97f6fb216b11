"""The recorder as a node: its core, what decides about its files, and the files."""

from collections.abc import Callable
from dataclasses import dataclass

from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply
from reactorwatch.errors import InputError
from reactorwatch.runtime.delivery.reorder_buffer import Gap
from recorder.core import Kept, Recorder
from recorder.files import RecordingFiles
from recorder.policy.black_box import BlackBox, Stretch
from recorder.policy.latched import Head
from recorder.policy.room import Room
from recorder.policy.rotation import Filing
from recorder.storage.mcap_writer import WriteError

RETRY_NS = 2_000_000_000
"""Between two looks for room on a full disk."""


@dataclass
class Decisions:
    """What decides about the files, without touching them."""

    filing: Filing
    head: Head
    black_box: BlackBox
    room: Room


class RecorderNode:
    """Writes what it receives; see `reactorwatch.runtime.event_loop.Node`.

    Its reports of health go out on the bus and come back as everything else does, so they are not written here. The
    last one alone is, because nobody listens any more when it would come back.

    Args:
        core: what it makes of messages.
        decide: what decides about its files.
        files: the files; one was begun.
        health_period_ns: between two reports.
        start_ns: the clock.
        has_room: whether a full disk has room enough to go on.
    """

    def __init__(
        self,
        core: Recorder,
        decide: Decisions,
        files: RecordingFiles,
        health_period_ns: int,
        start_ns: int,
        has_room: Callable[[], bool] = lambda: True,
    ) -> None:
        self._core = core
        self._filing, self._head, self._black_box = decide.filing, decide.head, decide.black_box
        self._room = decide.room
        self._files = files
        self._health_period_ns = health_period_ns
        self._next_health_ns = start_ns
        self._next_try_ns = start_ns
        self._has_room = has_room

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Write it, and do what is due with the file."""
        kept = self._core.on_message(message, now_ns)
        if kept is None:
            return []
        told = self._write(kept, now_ns)
        if kept.message is not None and self._room.has(kept.channel):
            self._head.remember(kept.entry, kept.message)
            over = self._black_box.on_message(kept.message, kept.entry.log_time_ns)
            told += self._keep_for_good(over, now_ns)
        return told

    def on_gap(self, gap: Gap, now_ns: int) -> list[Publication]:
        """Write that something was lost on the way."""
        self._core.on_gap(gap)
        if self._core.is_stopped:
            return []
        try:
            self._files.write_gap(gap)
        except InputError as error:
            return self._stop(error, now_ns)
        return []

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """What people ask of its alarm, or do to it."""
        return self._core.on_command(question, now_ns)

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Flush the file, look for room on a full disk, keep a stretch for good, report health: each when it is due."""
        told = self._try_again(now_ns) if self._core.is_stopped else self._see_to_file(now_ns)
        told += self._keep_for_good(self._black_box.over(now_ns), now_ns)
        if now_ns >= self._next_health_ns:
            self._next_health_ns = now_ns + self._health_period_ns
            told += self._core.see_to_room(now_ns)
            told.append(self._core.health(now_ns))
        return told

    def alarms(self) -> list[Alarm]:
        """Its alarms as they are."""
        return self._core.alarms

    def next_tick_ns(self) -> int:
        """The next of these."""
        file_ns = self._next_try_ns if self._core.is_stopped else self._filing.next_due_ns()
        stretch_ns = self._black_box.next_due_ns
        return min(self._next_health_ns, file_ns, *([] if stretch_ns is None else [stretch_ns]))

    @property
    def finished(self) -> bool:
        """It records until it is stopped."""
        return False

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Write and send the last report."""
        last = self._core.health(now_ns, phase="stopped")
        told = self.on_message(encode(last), now_ns)
        told += self._keep_for_good(self._black_box.close(), now_ns)
        return [*told, last]

    def _keep_for_good(self, over: Stretch | None, now_ns: int) -> list[Publication]:
        """Have a stretch copied that is over, after all of it was handed over."""
        if over is None:
            return []
        told: list[Publication] = []
        try:
            self._files.flush()
            self._filing.flushed()
        except WriteError as error:
            told = self._stop(error, now_ns)
        self._files.keep_for_good(over)
        return told

    def _write(self, kept: Kept, now_ns: int) -> list[Publication]:
        if self._core.is_stopped:
            self._core.unrecorded(1)
            return []
        try:
            crowded = self._room.needs_new_file(kept.channel, now_ns)
            if crowded or self._filing.is_full(now_ns, self._files.size_bytes):
                self._begin(kept.entry.log_time_ns, now_ns)
            if not self._room.admit(kept.channel, now_ns):
                return self._core.leave_out(kept, now_ns)
            self._files.write(kept)
        except InputError as error:
            self._core.unrecorded(1)
            return self._stop(error, now_ns)
        self._filing.wrote(now_ns)
        return self._see_to_file(now_ns)

    def _begin(self, begun_ns: int, now_ns: int) -> None:
        self._files.complete()
        self._filing.flushed()
        head = self._head.entries(begun_ns)
        self._room.start(len(head))
        self._files.begin(head, now_ns)
        self._filing.began(now_ns)
        self._files.delete_oldest(self._black_box.needed_ns(now_ns))

    def _see_to_file(self, now_ns: int) -> list[Publication]:
        try:
            if self._filing.flush_is_due(now_ns):
                self._files.flush()
                self._filing.flushed()
            if self._filing.sync_is_due(now_ns):
                self._files.sync()
                self._filing.synced(now_ns)
        except InputError as error:
            return self._stop(error, now_ns)
        return []

    def _stop(self, error: InputError, now_ns: int) -> list[Publication]:
        """Leave the file as it is, for lack of room or worse; it is made whole when there is another one."""
        self._core.unrecorded(self._filing.unflushed)
        self._filing.began(now_ns)
        self._files.abandon()
        self._next_try_ns = now_ns + RETRY_NS
        return self._core.stop_recording(error.reason if isinstance(error, WriteError) else str(error), now_ns)

    def _try_again(self, now_ns: int) -> list[Publication]:
        if now_ns < self._next_try_ns:
            return []
        self._next_try_ns = now_ns + RETRY_NS
        if not self._has_room():
            self._files.delete_oldest(self._black_box.needed_ns(now_ns))
            return []
        try:
            self._begin(self._core.moment(now_ns), now_ns)
        except InputError:
            self._files.abandon()
            return []
        return self._core.resume_recording(now_ns)
