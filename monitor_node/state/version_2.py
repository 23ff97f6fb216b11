"""Layout 2 of a monitor's state: a run of samples had its newest number and its spacing as fields of its own."""

import msgspec

from monitor_node.ingest.sampling import Spacing
from monitor_node.ingest.sequence_check import HeldSample, SequenceCheck


class _Run(msgspec.Struct, forbid_unknown_fields=True):
    number: int | None
    time_ns: int
    spacing_ns: float
    deviation_ns: float
    spacings: int
    held: list[HeldSample]

    def to_check(self) -> SequenceCheck:
        expected = None if self.number is None else self.number + 1
        spacing = Spacing(self.spacings, self.spacing_ns, self.deviation_ns)
        return SequenceCheck(expected, self.time_ns, spacing=spacing, held=self.held)


def upgrade(body: bytes) -> bytes:
    """Body in layout 3 of one in layout 2.

    Raises:
        ValueError: the body is not in layout 2.
    """
    try:
        fields = msgspec.msgpack.decode(body, type=dict[str, msgspec.Raw])
        runs = msgspec.msgpack.decode(fields["runs"], type=list[_Run])
    except (msgspec.DecodeError, UnicodeDecodeError, KeyError) as error:
        raise ValueError(f"the runs of samples cannot be read: {error}") from error
    fields["runs"] = msgspec.Raw(msgspec.msgpack.encode([run.to_check() for run in runs]))
    return msgspec.msgpack.encode(fields)
