"""Actuators: from a command to a physical input."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Actuator:
    """An actuator, such as a valve or a pump, whose input is its command, limited to its range.

    Attributes:
        lower: smallest input, in its unit.
        upper: largest input.
    """

    lower: float
    upper: float

    def limit(self, command: float) -> float:
        """The input at a command."""
        return min(max(command, self.lower), self.upper)

    def reaches(self, command: float) -> bool:
        """True if a command is within the range."""
        return self.lower <= command <= self.upper
