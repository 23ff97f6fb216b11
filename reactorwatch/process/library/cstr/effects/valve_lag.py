"""Lag of the coolant valve."""

from reactorwatch.process.input_effects import InputLag


class ValveLag(InputLag):
    """The real coolant flow follows qc with a time constant of m."""

    name = "valve_lag"
    label = "slow coolant valve"
    location = "coolant"
    larger = "coolant flow follows its command with a time constant of {} min"
    input = "qc"
    is_traced = False
