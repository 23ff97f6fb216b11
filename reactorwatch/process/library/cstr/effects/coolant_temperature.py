"""Deviation of the coolant's inlet temperature."""

from reactorwatch.process.effect import ParameterShift


class CoolantTemperature(ParameterShift):
    """Tcf + m."""

    name = "coolant_temperature"
    label = "wrong coolant temperature"
    location = "coolant"
    unit = "K"
    larger = "coolant warmer by {} K"
    smaller = "coolant colder by {} K"
    lower = -50.0
    upper = 50.0
    typical = 2.0
    parameter = "Tcf"
