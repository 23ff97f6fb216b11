"""Metadata records of messages lost on the bus, one a gap. Pure.

Publishers number their messages (`reactorwatch.runtime.delivery.reorder_buffer`), so the number and the range of lost
messages is known.
"""

from datetime import UTC, datetime

from reactorwatch.runtime.delivery.reorder_buffer import Gap

GAP = "reactorwatch.gap"
"""Name of the records."""


def to_metadata(gap: Gap) -> dict[str, str]:
    """Metadata record of a gap."""
    return {
        "stream": gap.stream,
        "publisher": f"{gap.publisher:016x}",
        "first": str(gap.first),
        "last": str(gap.last),
        "messages": str(gap.messages),
        "noticed_ns": str(gap.noticed_ns),
        "noticed": datetime.fromtimestamp(gap.noticed_ns / 1e9, UTC).isoformat(timespec="milliseconds"),
    }


def from_metadata(metadata: dict[str, str]) -> Gap | None:
    """Gap of a metadata record; None if it is not one of a gap."""
    try:
        return Gap(
            metadata["stream"],
            int(metadata["publisher"], 16),
            int(metadata["first"]),
            int(metadata["last"]),
            int(metadata["messages"]),
            int(metadata["noticed_ns"]),
        )
    except (KeyError, ValueError):
        return None
