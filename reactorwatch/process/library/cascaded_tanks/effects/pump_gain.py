"""Gain error of the pump."""

from reactorwatch.process.effect import ParameterEffect


class PumpGain(ParameterEffect):
    """k4 (1 + m)."""

    name = "pump_gain"
    label = "wrong flow of the pump"
    location = "pump"
    unit = "1"
    larger = "{} % more flow from the pump"
    smaller = "{} % less flow from the pump"
    lower = -0.99
    upper = 4.0
    typical = 0.03
    parameter = "k4"
