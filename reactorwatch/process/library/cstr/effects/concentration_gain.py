"""Gain error of the analyser."""

from typing import ClassVar

from reactorwatch.process.output_effects import OutputGain


class ConcentrationGain(OutputGain):
    """The measured concentration is C (1 + m)."""

    name = "concentration_gain"
    label = "wrong gain of the analyser"
    location = "concentration_sensor"
    larger = "analyser shows {} % too much"
    smaller = "analyser shows {} % too little"
    output = "C"
    labels: ClassVar[dict[str, str]] = {"ramp": "drift of the gain of the analyser"}
