"""The recorder as a node: its core, and the file that it writes."""

from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import CommandReply
from recorder.core import Recorder
from recorder.mcap_file import RecordingWriter


class RecorderNode:
    """Writes what it receives; see `reactorwatch.runtime.serve.Node`.

    Its reports of health go out on the bus and come back as everything else does, so they are not written here. The
    last one alone is, because nobody listens any more when it would come back.
    """

    def __init__(
        self, core: Recorder, writer: RecordingWriter, health_period_ns: int, flush_period_ns: int, start_ns: int
    ) -> None:
        self._core = core
        self._writer = writer
        self._health_period_ns = health_period_ns
        self._flush_period_ns = flush_period_ns
        self._next_health_ns = start_ns
        self._next_flush_ns = start_ns + flush_period_ns

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Write it."""
        kept = self._core.on_message(message, now_ns)
        if kept is not None:
            self._writer.write(kept.entry, readable=kept.readable)
        return []

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """It takes none."""
        return CommandReply(accepted=False, text="the recorder takes no commands"), []

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Flush the file and report health, each when it is due."""
        if now_ns >= self._next_flush_ns:
            self._writer.flush()
            self._next_flush_ns = now_ns + self._flush_period_ns
        if now_ns < self._next_health_ns:
            return []
        self._next_health_ns = now_ns + self._health_period_ns
        return [self._core.health(now_ns)]

    def next_tick_ns(self) -> int:
        """The next flush or report."""
        return min(self._next_flush_ns, self._next_health_ns)

    @property
    def finished(self) -> bool:
        """It records until it is stopped."""
        return False

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Write and send the last report."""
        last = self._core.health(now_ns, phase="stopped")
        self.on_message(encode(last), now_ns)
        return [last]
