"""Delay of the analyser."""

from reactorwatch.process.output_effects import OutputDelay


class ConcentrationDelay(OutputDelay):
    """The measured concentration is C(t - m).

    With the coolant stepping every minute over its whole range, the simulation's error is 0.0001 mol/l (root mean
    square) up to m = 1 min, 0.001 at 2 min, 0.003 at 3 min.
    """

    name = "concentration_delay"
    label = "delay of the analyser"
    location = "concentration_sensor"
    larger = "analyser shows what was there {} min before"
    output = delays_output = "C"
    scale = 0.1
    is_traced = False
