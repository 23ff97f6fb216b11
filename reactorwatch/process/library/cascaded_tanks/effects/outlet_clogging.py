"""Clogging of the upper tank's outlet."""

import casadi as ca

from reactorwatch.process.effect import ParameterEffect
from reactorwatch.process.model import ProcessModel


class OutletClogging(ParameterEffect):
    """The outlet of the upper tank lets (1 - m) of the water through: k1 (1 - m) and k2 (1 - m)."""

    name = "outlet_clogging"
    label = "clogged outlet of the upper tank"
    location = "upper_tank"
    larger = "{} % of the outlet of the upper tank clogged"
    lower = 0.0
    upper = 0.99
    typical = 0.03
    parameter = "k1"
    proportional = ("k2",)

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return super().apply(model, -size)
