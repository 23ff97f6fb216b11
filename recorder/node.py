"""The recorder as a node: core, file policies and files."""

from collections.abc import Collection

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply
from reactorwatch.errors import InputError
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime.bus import Node
from reactorwatch.runtime.reorder_buffer import Gap
from recorder.config import MB, RecorderConfig
from recorder.core import NODE, PRIORITIES, ReceivedMessage, Recorder
from recorder.files.writer import WriteError
from recorder.keep import STATES, AlarmInterval, BlackBox, ChannelBudget, FlushAndRotation, LatchedMessages
from recorder.recording_files import RecordingFiles

RETRY_NS = 2_000_000_000
"""Time between two attempts to resume on a full disk."""


class RecorderNode(Node):
    """Records received messages.

    It starts with a new file, while what a killed recorder left is recovered. Its health reports are published and
    received like any message, so they are not written here. The exception is the last one, which would arrive after the
    subscription ends.

    Args:
        config: the settings.
        files: the files, without a started one.
        start_ns: clock reading at the start.
        fingerprints: see `Recorder`.
        fingerprints_until_ns: see `Recorder`.
    """

    def __init__(
        self,
        config: RecorderConfig,
        files: RecordingFiles,
        start_ns: int,
        fingerprints: Collection[int] = (),
        fingerprints_until_ns: int = 0,
    ) -> None:
        self._config, self._files = config, files
        self._core = Recorder(config.plant, start_ns, fingerprints, fingerprints_until_ns)
        self._rotation = FlushAndRotation(
            round(config.flush_period_s * 1e9),
            config.fsync,
            config.rotate_min * MINUTE_NS,
            config.rotate_mb * MB,
            start_ns,
        )
        own = [keys.key(config.plant, keys.ALARM, name) for name in PRIORITIES]
        self._channels = ChannelBudget(config.most_keys, (*own, keys.key(config.plant, keys.HEALTH, NODE)))
        self._latched = LatchedMessages(config.most_keys // 2)
        self._black_box = BlackBox(round(config.black_box_min * MINUTE_NS), own=tuple(PRIORITIES))
        self._next_health_ns = self._next_retry_ns = start_ns
        missed = files.find_missed_intervals(self._black_box, start_ns)
        files.start_file((), start_ns)
        for interval in missed:
            files.save_black_box(interval)

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Write a message, and flush or rotate the file if due."""
        received = self._core.on_message(message, now_ns)
        if received is None:
            return []
        published = self._write(received, now_ns)
        content = received.message
        if content is not None and type(content) in STATES and self._channels.has(received.channel):
            self._latched.update(received.recorded_message, content)
            ended = self._black_box.on_message(content, received.log_time_ns)
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
            self._next_health_ns = now_ns + round(self._config.health_period_s * 1e9)
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
            if self._rotation.is_full(now_ns, self._files.size_bytes):
                self._start_file(received.log_time_ns, now_ns)
            if not channels.admit(channel, now_ns):
                if not channels.needs_new_file(channel, now_ns):
                    return self._core.reject_key(received, now_ns)
                self._start_file(received.log_time_ns, now_ns)
                channels.admit(channel, now_ns)
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
        if self._files.free_bytes < self._config.resume_mb * MB:
            self._files.delete_oldest(self._black_box.protected_ns(now_ns))
            return []
        try:
            self._start_file(self._core.monotonic_ns(now_ns), now_ns)
        except InputError:
            self._files.abandon()
            return []
        return self._core.resume_recording(now_ns)
