"""What cannot be used, counted by reason, and said aloud at most once a minute."""

from dataclasses import dataclass, field

REPORT_EVERY_NS = 60_000_000_000
LONGEST_EXAMPLE = 300
"""Characters. What is refused may be named by whoever sent it, in as many words as he likes."""


@dataclass
class Refusals:
    """Counts of messages that were refused.

    Attributes:
        by_reason: how many, since the start.
    """

    by_reason: dict[str, int] = field(default_factory=dict)
    _unsaid: dict[str, str] = field(default_factory=dict)
    _said_ns: int | None = None

    def add(self, reason: str, example: str) -> None:
        """Count one; `example` says what it was."""
        self.by_reason[reason] = self.by_reason.get(reason, 0) + 1
        if reason not in self._unsaid:
            self._unsaid[reason] = example if len(example) <= LONGEST_EXAMPLE else f"{example[:LONGEST_EXAMPLE]}..."

    @property
    def total(self) -> int:
        """All reasons together."""
        return sum(self.by_reason.values())

    def report(self, now_ns: int) -> str | None:
        """One line on what was refused since the last report; None if nothing was, or that was within the minute."""
        if not self._unsaid or (self._said_ns is not None and now_ns - self._said_ns < REPORT_EVERY_NS):
            return None
        self._said_ns = now_ns
        examples = "; ".join(
            f"{reason} ({self.by_reason[reason]} so far): {text}" for reason, text in self._unsaid.items()
        )
        self._unsaid.clear()
        return f"refused messages: {examples}"
