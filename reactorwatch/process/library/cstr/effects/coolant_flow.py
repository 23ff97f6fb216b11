"""Deviation of the coolant flow from its command."""

from typing import ClassVar

from reactorwatch.process.input_effects import InputGain


class CoolantFlow(InputGain):
    """The real coolant flow is qc (1 + m)."""

    name = "coolant_flow"
    label = "wrong coolant flow"
    location = "coolant"
    larger = "{} % more coolant than commanded"
    smaller = "{} % of the coolant lost"
    labels: ClassVar[dict[str, str]] = {"step": "coolant leak", "constant": "wrong gain of the coolant valve"}
    input = "qc"
