"""Bias of the temperature sensor."""

from typing import ClassVar

from reactorwatch.process.output_effects import OutputBias


class TemperatureBias(OutputBias):
    """The measured temperature is T + m."""

    name = "temperature_bias"
    label = "bias of the temperature sensor"
    location = "temperature_sensor"
    unit = "K"
    larger = "thermometer shows {} K too much"
    smaller = "thermometer shows {} K too little"
    lower = -100.0
    upper = 100.0
    typical = 2.0
    output = "T"
    labels: ClassVar[dict[str, str]] = {"ramp": "drift of the temperature sensor"}
