"""Deviation of the volume of the contents."""

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel


class Volume(Effect):
    """V (1 + m); flows and hA are unchanged, so q/V and K2, which has 1/V as a factor, are divided by 1 + m.

    With level control, the set point is V_set (1 + m), and the level responds.
    """

    name = "volume"
    label = "wrong volume of the contents"
    location = "mass_balance"
    unit = "1"
    larger = "{} % more contents than stated"
    smaller = "{} % less contents than stated"
    lower = -0.9
    upper = 4.0
    typical = 0.03
    is_traced = False

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        volume = model.parameter("V_set" if "V_set" in model.parameter_names else "V").symbol
        cooling = model.parameter("K2").symbol
        return model.substitute(volume, volume * (1 + size)).substitute(cooling, cooling / (1 + size))
