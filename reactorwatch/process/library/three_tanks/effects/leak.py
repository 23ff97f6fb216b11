"""Leak of a tank."""

from typing import ClassVar

import casadi as ca

from reactorwatch.process.effect import Effect, make_effect
from reactorwatch.process.library.three_tanks.model import leak_name
from reactorwatch.process.model import ProcessModel


class Leak(Effect):
    """A tank loses m s sqrt(2 g h) through a hole: m is the share of a pipe's cross-section that is open."""

    unit = "1"
    lower = 0.0
    upper = 5.0
    typical = 0.05
    tank: ClassVar[int]

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return model.add_rate(f"h{self.tank}", size * model.term(leak_name(self.tank)))


LEAKS = tuple(
    make_effect(
        Leak,
        f"leak{tank}",
        f"Leak of tank {tank}.",
        __name__,
        location=f"tank{tank}",
        label=f"leak of tank {tank}",
        larger=f"tank {tank} leaks through {{}} % of a pipe's cross-section",
        tank=tank,
    )
    for tank in (1, 2, 3)
)
