"""Deviation of the reaction rate, the same at every temperature."""

from typing import ClassVar

from reactorwatch.process.effect import ParameterEffect


class ReactionRate(ParameterEffect):
    """k0 (1 + m), and K1 (1 + m), which has k0 as a factor."""

    name = "reaction_rate"
    label = "changed reaction rate"
    location = "reaction"
    larger = "reaction faster by {} %"
    smaller = "reaction slower by {} %"
    typical = 0.05
    parameter = "k0"
    proportional = ("K1",)
    labels: ClassVar[dict[str, str]] = {"decay": "deactivation of the catalyst"}
