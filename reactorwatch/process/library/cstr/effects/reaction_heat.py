"""Deviation of the heat of reaction at the same rate."""

from reactorwatch.process.effect import ParameterEffect


class ReactionHeat(ParameterEffect):
    """K1 (1 + m), k0 unchanged."""

    name = "reaction_heat"
    label = "wrong heat of reaction"
    location = "reaction"
    unit = "1"
    larger = "{} % more heat of reaction"
    smaller = "{} % less heat of reaction"
    lower = -0.99
    upper = 4.0
    typical = 0.01
    parameter = "K1"
