"""Lag of the temperature sensor."""

from reactorwatch.process.output_effects import OutputLag


class TemperatureLag(OutputLag):
    """The measured temperature follows T with a time constant of m, as in a thermowell."""

    name = "temperature_lag"
    label = "slow thermometer"
    location = "temperature_sensor"
    larger = "thermometer follows with a time constant of {} min"
    output = "T"
    scale = 10.0
    is_traced = False
