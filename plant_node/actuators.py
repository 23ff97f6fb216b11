"""Actuators: from a command to a physical input."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CoolantValve:
    """A valve whose flow is its command, limited to its range.

    Attributes:
        lower_l_min: flow when it is closed.
        upper_l_min: flow when it is open.
    """

    lower_l_min: float
    upper_l_min: float

    def flow(self, command_l_min: float) -> float:
        """The coolant flow in l/min at a command in l/min."""
        return min(max(command_l_min, self.lower_l_min), self.upper_l_min)

    def reaches(self, command_l_min: float) -> bool:
        """True if a command is within the valve's range."""
        return self.lower_l_min <= command_l_min <= self.upper_l_min
