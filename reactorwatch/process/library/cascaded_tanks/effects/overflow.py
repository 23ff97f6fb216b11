"""Overflow of the upper tank."""

import casadi as ca

from reactorwatch.process.effect import Effect, EffectConstant
from reactorwatch.process.model import ProcessModel

BRIM_V = 10.0
"""Level of the brim of the upper tank, where nothing else is known."""

CAUGHT = 0.5
"""Share of the overflow that enters the lower tank, where nothing else is known; the rest is lost."""

SOFT_V = 0.005
"""Half width of the transition at the brim."""


class Overflow(Effect):
    """m times the level above the brim runs over: a share of it into the lower tank, the rest beside it.

    The brim and the share that is caught are fitted, too. The overflow has a kink at the brim, where it has no
    derivative; so it sets in within some hundredths of a volt, as (h + (h^2 + s^2)^(1/2)) / 2 with h the level above
    the brim. The larger m is, the closer the level stays to the brim.
    """

    name = "overflow"
    label = "overflow of the upper tank"
    location = "upper_tank"
    unit = "1/min"
    larger = "overflow of {} 1/min of the level above the brim"
    lower = 0.0
    upper = 60.0
    typical = 5.0
    constants = (
        EffectConstant("brim", BRIM_V, 2.0, "V", 0.1, 50.0, "level of the brim of the upper tank", (6.0, 8.0)),
        EffectConstant(
            "caught", CAUGHT, 0.3, "1", 0.0, 1.0, "share of the overflow that enters the lower tank", (0.2, 0.8)
        ),
    )

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        extended, (brim, caught) = self.add_constants(model)
        above = model.states[model.state_index("x1")].symbol - brim
        twice = above + ca.sqrt(above**2 + SOFT_V**2)
        # k1 and k2 are of one flow over the cross-section of either tank.
        widths = model.parameter("k2").symbol / model.parameter("k1").symbol
        return extended.add_rate("x1", -0.5 * size * twice).add_rate("x2", 0.5 * caught * size * widths * twice)
