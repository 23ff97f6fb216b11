"""Deviation of the heat of reaction at the same rate."""

from reactorwatch.process.effect import ParameterEffect


class ReactionHeat(ParameterEffect):
    """K1 (1 + m), k0 unchanged."""

    name = "reaction_heat"
    label = "wrong heat of reaction"
    location = "reaction"
    larger = "{} % more heat of reaction"
    smaller = "{} % less heat of reaction"
    typical = 0.01
    parameter = "K1"
