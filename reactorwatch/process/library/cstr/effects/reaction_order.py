"""Deviation of the reaction order from one."""

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

REFERENCE_MOL_L = 0.1
"""Concentration at which the rate is unchanged: that of the operating point."""

LEAST_MOL_L = 1e-9
"""Lower bound of the concentration; a solver may reach negative values."""


class ReactionOrder(Effect):
    """The rate, and the heat with it, times (C / 0.1)^m: the order is 1 + m."""

    name = "reaction_order"
    label = "wrong order of the reaction"
    location = "reaction"
    unit = "1"
    larger = "order of the reaction higher by {}"
    smaller = "order of the reaction lower by {}"
    lower = -0.9
    upper = 2.0
    typical = 0.05
    is_traced = False

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        C = model.states[model.state_index("C")].symbol
        factor = (ca.fmax(C, LEAST_MOL_L) / REFERENCE_MOL_L) ** size
        for name in ("k0", "K1"):
            symbol = model.parameter(name).symbol
            model = model.substitute(symbol, symbol * factor)
        return model
