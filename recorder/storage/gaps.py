"""What never came, as a recording tells it: a metadata record for each gap. Pure.

The bus numbers what a node publishes of one kind (`reactorwatch.runtime.delivery.reorder_buffer`). What was lost on the
way and could not be recovered is among these numbers, so it is known how much is missing, of what, and from where to
where.
"""

from datetime import UTC, datetime

from reactorwatch.runtime.delivery.reorder_buffer import Gap

GAP = "reactorwatch.gap"
"""The name of these records."""


def to_metadata(gap: Gap) -> dict[str, str]:
    """The record of a gap."""
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
    """The gap of a record; None if it tells of none."""
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
