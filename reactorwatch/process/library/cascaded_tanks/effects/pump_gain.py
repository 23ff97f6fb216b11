"""Gain error of the pump."""

from reactorwatch.process.effect import ParameterEffect


class PumpGain(ParameterEffect):
    """k4 (1 + m)."""

    name = "pump_gain"
    label = "wrong flow of the pump"
    location = "pump"
    larger = "{} % more flow from the pump"
    smaller = "{} % less flow from the pump"
    typical = 0.03
    parameter = "k4"
