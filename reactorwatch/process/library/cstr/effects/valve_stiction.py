"""Stiction of the coolant valve."""

from reactorwatch.process.input_effects import InputStiction


class ValveStiction(InputStiction):
    """The valve moves only when qc is more than m away from it; then it goes to qc."""

    name = "valve_stiction"
    label = "sticking coolant valve"
    location = "coolant"
    unit = "l/min"
    larger = "valve moves only for changes of more than {} l/min"
    upper = 100.0
    typical = 2.0
    start_values = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)
    input = "qc"
    is_traced = False
