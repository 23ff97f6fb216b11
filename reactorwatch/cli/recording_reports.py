"""What `recover` and `info` print: a JSON object for machines, a few lines for people."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from recorder.recover import Saved


def saved_object(saved: Saved, out: Path) -> dict[str, Any]:
    """The object that `recover --json` prints."""
    return {
        "file": str(out),
        "messages": saved.messages,
        "first_ns": saved.first_ns,
        "last_ns": saved.last_ns,
        "topics": saved.topics,
        "lost": [{"at_byte": damage.at_byte, "what": damage.what} for damage in saved.damages],
        "orphans": saved.orphans,
    }


def saved_text(saved: Saved, file: Path, out: Path) -> str:
    """The same for people."""
    span_s = (saved.last_ns - saved.first_ns) / 1e9
    return "\n".join(
        [
            f"{file}: saved {saved.messages} messages of {len(saved.topics)} topics, received over {span_s:.1f} s "
            f"({moment(saved.first_ns)} to {moment(saved.last_ns)})",
            *(f"  {count:9d}  {topic}" for topic, count in sorted(saved.topics.items())),
            f"not saved: {saved.lost}" if saved.lost else "nothing was damaged",
            f"wrote {out}",
        ]
    )


def moment(time_ns: int) -> str:
    """A time for people."""
    try:
        return datetime.fromtimestamp(time_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (OverflowError, ValueError, OSError):
        return f"{time_ns} ns"
