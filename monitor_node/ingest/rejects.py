"""Count rejected messages by reason; report them at most once a minute."""

from dataclasses import dataclass, field

LOG_INTERVAL_NS = 60_000_000_000
LONGEST_EXAMPLE = 300
"""Characters. Senders control this text; truncate it."""


@dataclass
class RejectCounter:
    """Counter of rejected messages.

    Attributes:
        by_reason: number of rejected messages by reason since the start.
    """

    by_reason: dict[str, int] = field(default_factory=dict)
    _pending_report: dict[str, str] = field(default_factory=dict)
    _last_report_ns: int | None = None

    def add(self, reason: str, example: str) -> None:
        """Count a message; `example` describes it."""
        self.by_reason[reason] = self.by_reason.get(reason, 0) + 1
        if reason not in self._pending_report:
            self._pending_report[reason] = (
                example if len(example) <= LONGEST_EXAMPLE else f"{example[:LONGEST_EXAMPLE]}..."
            )

    @property
    def total(self) -> int:
        """Total over all reasons."""
        return sum(self.by_reason.values())

    def report(self, now_ns: int) -> str | None:
        """One line on messages rejected since the last report; None if there are none, or the report is too recent."""
        if not self._pending_report or (
            self._last_report_ns is not None and now_ns - self._last_report_ns < LOG_INTERVAL_NS
        ):
            return None
        self._last_report_ns = now_ns
        examples = "; ".join(
            f"{reason} ({self.by_reason[reason]} so far): {text}" for reason, text in self._pending_report.items()
        )
        self._pending_report.clear()
        return f"refused messages: {examples}"
