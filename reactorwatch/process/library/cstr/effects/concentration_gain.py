"""Gain error of the analyser."""

from typing import ClassVar

import casadi as ca

from reactorwatch.process.effect import ReadingEffect


class ConcentrationGain(ReadingEffect):
    """The measured concentration is C (1 + m)."""

    name = "concentration_gain"
    label = "wrong gain of the analyser"
    location = "concentration_sensor"
    unit = "1"
    larger = "analyser shows {} % too much"
    smaller = "analyser shows {} % too little"
    lower = -0.99
    upper = 4.0
    typical = 0.1
    output = "C"
    labels: ClassVar[dict[str, str]] = {"ramp": "drift of the gain of the analyser"}

    def reading(self, value: ca.SX, size: ca.SX) -> ca.SX:
        """See `ReadingEffect`."""
        return value * (1 + size)
