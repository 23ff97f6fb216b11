"""Clogging of the upper tank's outlet."""

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel


class OutletClogging(Effect):
    """The outlet of the upper tank lets (1 - m) of the water through: k1 (1 - m) and k2 (1 - m)."""

    name = "outlet_clogging"
    label = "clogged outlet of the upper tank"
    location = "upper_tank"
    unit = "1"
    larger = "{} % of the outlet of the upper tank clogged"
    lower = 0.0
    upper = 0.99
    typical = 0.03

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`.

        Raises:
            ValueError: the model has no parameter k1 or k2.
        """
        for name in ("k1", "k2"):
            symbol = model.parameter(name).symbol
            model = model.substitute(symbol, symbol * (1 - size))
        return model
