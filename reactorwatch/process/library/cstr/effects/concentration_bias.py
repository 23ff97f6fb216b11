"""Bias of the analyser."""

from typing import ClassVar

from reactorwatch.process.output_effects import OutputBias


class ConcentrationBias(OutputBias):
    """The measured concentration is C + m."""

    name = "concentration_bias"
    label = "bias of the analyser"
    location = "concentration_sensor"
    unit = "mol/l"
    larger = "analyser shows {} mol/l too much"
    smaller = "analyser shows {} mol/l too little"
    lower = -1.0
    upper = 1.0
    typical = 0.01
    output = "C"
    labels: ClassVar[dict[str, str]] = {"ramp": "drift of the analyser"}
