"""Bias of the level sensor."""

from typing import ClassVar

from reactorwatch.process.output_effects import OutputBias


class LevelBias(OutputBias):
    """The measured level is x2 + m."""

    name = "level_bias"
    label = "bias of the level sensor"
    location = "level_sensor"
    unit = "V"
    larger = "level sensor shows {} V too much"
    smaller = "level sensor shows {} V too little"
    lower = -10.0
    upper = 10.0
    typical = 0.05
    output = "x2"
    labels: ClassVar[dict[str, str]] = {"ramp": "drift of the level sensor"}
