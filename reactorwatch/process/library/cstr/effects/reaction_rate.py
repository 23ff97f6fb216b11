"""Deviation of the reaction rate, the same at every temperature."""

from typing import ClassVar

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel


class ReactionRate(Effect):
    """k0 (1 + m), and K1 (1 + m), which has k0 as a factor."""

    name = "reaction_rate"
    label = "changed reaction rate"
    location = "reaction"
    unit = "1"
    larger = "reaction faster by {} %"
    smaller = "reaction slower by {} %"
    lower = -0.99
    upper = 4.0
    typical = 0.05
    labels: ClassVar[dict[str, str]] = {"decay": "deactivation of the catalyst"}

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        for name in ("k0", "K1"):
            symbol = model.parameter(name).symbol
            model = model.substitute(symbol, symbol * (1 + size))
        return model
