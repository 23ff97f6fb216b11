"""The recorder as a node: core, file policies and files."""

from collections.abc import Callable
from dataclasses import dataclass

from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply
from reactorwatch.errors import InputError
from reactorwatch.runtime.delivery.reorder_buffer import Gap
from recorder.core import ReceivedMessage, Recorder
from recorder.files.writer import WriteError
from recorder.keep import STATES, AlarmInterval, BlackBox, ChannelBudget, FlushAndRotation, LatchedMessages
from recorder.recording_files import RecordingFiles

RETRY_NS = 2_000_000_000
"""Time between two attempts to resume on a full disk."""


@dataclass
class Policies:
    """Policies for the files, without I/O."""

    rotation: FlushAndRotation
    latched: LatchedMessages
    black_box: BlackBox
    channels: ChannelBudget


class RecorderNode:
    """Records received messages; see `reactorwatch.runtime.event_loop.Node`.

    Its health reports are published and received like any message, so they are not written here. The exception is the
    last one, which would arrive after the subscription ends.

    Args:
        core: decodes and counts messages.
        policies: policies for the files.
        files: the files; one was started.
        health_period_ns: time between two health reports.
        start_ns: clock reading at the start.
        has_room: returns True if a full disk has enough room to resume.
    """

    def __init__(
        self,
        core: Recorder,
        policies: Policies,
        files: RecordingFiles,
        health_period_ns: int,
        start_ns: int,
        has_room: Callable[[], bool] = lambda: True,
    ) -> None:
        self._core = core
        self._rotation, self._latched = policies.rotation, policies.latched
        self._black_box, self._channels = policies.black_box, policies.channels
        self._files = files
        self._health_period_ns = health_period_ns
        self._next_health_ns = start_ns
        self._next_retry_ns = start_ns
        self._has_room = has_room

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Write a message, and flush or rotate the file if due."""
        received = self._core.on_message(message, now_ns)
        if received is None:
            return []
        published = self._write(received, now_ns)
        content = received.message
        if content is not None and type(content) in STATES and self._channels.has(received.channel):
            self._latched.update(received.recorded, content)
            ended = self._black_box.on_message(content, received.recorded.log_time_ns)
            published += self._save_black_box(ended, now_ns)
        return published

    def on_gap(self, gap: Gap, now_ns: int) -> list[Publication]:
        """Record a gap in the messages of the bus."""
        self._core.on_gap(gap)
        if self._core.is_stopped:
            return []
        try:
            self._files.write_gap(gap)
        except InputError as error:
            return self._stop(error, now_ns)
        return []

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Execute a command about the recorder's alarms."""
        return self._core.alarms.execute(question, now_ns)

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Flush, retry on a full disk, save a black box and report health, each when due."""
        published = self._retry(now_ns) if self._core.is_stopped else self._flush_if_due(now_ns)
        published += self._save_black_box(self._black_box.pop_ended(now_ns), now_ns)
        if now_ns >= self._next_health_ns:
            self._next_health_ns = now_ns + self._health_period_ns
            published += self._core.clear_keys_alarm(now_ns)
            published.append(self._core.health(now_ns))
        return published

    def alarms(self) -> list[Alarm]:
        """The recorder's alarms in their present state."""
        return self._core.alarms.now

    def next_tick_ns(self) -> int:
        """Time of the next due action."""
        file_ns = self._next_retry_ns if self._core.is_stopped else self._rotation.next_due_ns()
        interval_ns = self._black_box.next_due_ns
        return min(self._next_health_ns, file_ns, *([] if interval_ns is None else [interval_ns]))

    @property
    def finished(self) -> bool:
        """False: it records until it is stopped."""
        return False

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Record and publish the last health report."""
        last = self._core.health(now_ns, phase="stopped")
        published = self.on_message(encode(last), now_ns)
        published += self._save_black_box(self._black_box.close(), now_ns)
        return [*published, last]

    def _save_black_box(self, ended: AlarmInterval | None, now_ns: int) -> list[Publication]:
        """Flush, then copy an interval that has ended."""
        if ended is None:
            return []
        published: list[Publication] = []
        try:
            self._files.flush()
            self._rotation.mark_flushed()
        except WriteError as error:
            published = self._stop(error, now_ns)
        self._files.save_black_box(ended)
        return published

    def _write(self, received: ReceivedMessage, now_ns: int) -> list[Publication]:
        if self._core.is_stopped:
            self._core.count_unrecorded(1)
            return []
        channels, channel = self._channels, received.channel
        try:
            channels_full = not channels.has(channel) and channels.needs_new_file(channel, now_ns)
            if channels_full or self._rotation.is_full(now_ns, self._files.size_bytes):
                self._start_file(received.recorded.log_time_ns, now_ns)
            if not channels.admit(channel, now_ns):
                return self._core.reject_key(received, now_ns)
            self._files.write(received)
        except InputError as error:
            self._core.count_unrecorded(1)
            return self._stop(error, now_ns)
        self._rotation.count_message(now_ns)
        return self._flush_if_due(now_ns)

    def _start_file(self, start_ns: int, now_ns: int) -> None:
        self._files.complete()
        self._rotation.mark_flushed()
        latched = self._latched.messages(start_ns)
        self._channels.reset(len(latched))
        self._files.start_file(latched, now_ns)
        self._rotation.start_file(now_ns)
        self._files.delete_oldest(self._black_box.protected_ns(now_ns))

    def _flush_if_due(self, now_ns: int) -> list[Publication]:
        try:
            if self._rotation.flush_is_due(now_ns):
                self._files.flush()
                self._rotation.mark_flushed()
            if self._rotation.sync_is_due(now_ns):
                self._files.sync()
                self._rotation.mark_synced(now_ns)
        except InputError as error:
            return self._stop(error, now_ns)
        return []

    def _stop(self, error: InputError, now_ns: int) -> list[Publication]:
        """Abandon a file that cannot be written; it is recovered after the next one is started."""
        self._core.count_unrecorded(self._rotation.unflushed - self._files.abandon())
        self._rotation.start_file(now_ns)
        self._next_retry_ns = now_ns + RETRY_NS
        return self._core.stop_recording(error.reason if isinstance(error, WriteError) else str(error), now_ns)

    def _retry(self, now_ns: int) -> list[Publication]:
        if now_ns < self._next_retry_ns:
            return []
        self._next_retry_ns = now_ns + RETRY_NS
        if not self._has_room():
            self._files.delete_oldest(self._black_box.protected_ns(now_ns))
            return []
        try:
            self._start_file(self._core.monotonic_ns(now_ns), now_ns)
        except InputError:
            self._files.abandon()
            return []
        return self._core.resume_recording(now_ns)
