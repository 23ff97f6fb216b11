"""Deviation of a pump's flow."""

from reactorwatch.process.input_effects import InputOffset


class PumpFlow(InputOffset):
    """The real flow of a pump is Q + m."""

    unit = "cm3/s"
    lower = -150.0
    upper = 150.0
    typical = 1.0


class Pump1(PumpFlow):
    """The real flow of pump 1 is Q1 + m."""

    name = location = "pump1"
    label = "wrong flow of pump 1"
    larger = "{} cm3/s more from pump 1"
    smaller = "{} cm3/s less from pump 1"
    input = "Q1"


class Pump2(PumpFlow):
    """The real flow of pump 2 is Q2 + m."""

    name = location = "pump2"
    label = "wrong flow of pump 2"
    larger = "{} cm3/s more from pump 2"
    smaller = "{} cm3/s less from pump 2"
    input = "Q2"
