"""Leak of the upper tank."""

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cascaded_tanks.model import UPPER_OUTLET
from reactorwatch.process.model import ProcessModel


class UpperLeak(Effect):
    """Through a hole in its bottom the upper tank loses m root(x1), which no tank catches."""

    name = "upper_leak"
    label = "leak of the upper tank"
    location = "upper_tank"
    unit = "V^0.5/min"
    larger = "upper tank leaks with {} V^0.5/min"
    lower = 0.0
    upper = 30.0
    typical = 0.1

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return model.add_rate("x1", -size * model.term(UPPER_OUTLET))
