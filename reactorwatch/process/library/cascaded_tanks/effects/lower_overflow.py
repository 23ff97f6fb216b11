"""Overflow of the lower tank."""

import casadi as ca

from reactorwatch.process.effect import Effect, EffectConstant
from reactorwatch.process.library.cascaded_tanks.effects.overflow import SOFT_V
from reactorwatch.process.model import ProcessModel


class LowerOverflow(Effect):
    """m times the level above the brim of the lower tank runs over into the basin.

    The brim is fitted, too. The overflow sets in within some hundredths of a volt, as that of the upper tank does.
    """

    name = "lower_overflow"
    label = "overflow of the lower tank"
    location = "lower_tank"
    unit = "1/min"
    larger = "lower tank: overflow of {} 1/min of the level above the brim"
    lower = 0.0
    upper = 60.0
    typical = 5.0
    constants = (
        EffectConstant("brim", 10.0, 2.0, "V", 0.1, 50.0, "level of the brim of the lower tank", (4.0, 6.0, 8.0)),
    )

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        extended, (brim,) = self.add_constants(model)
        above = model.states[model.state_index("x2")].symbol - brim
        return extended.add_rate("x2", -0.5 * size * (above + ca.sqrt(above**2 + SOFT_V**2)))
