"""Deviation of the coolant flow from its command."""

from typing import ClassVar

import casadi as ca

from reactorwatch.process.effect import Effect, input_of
from reactorwatch.process.model import ProcessModel


class CoolantFlow(Effect):
    """The real coolant flow is qc (1 + m)."""

    name = "coolant_flow"
    label = "wrong coolant flow"
    location = "coolant"
    unit = "1"
    larger = "{} % more coolant than commanded"
    smaller = "{} % of the coolant lost"
    lower = -0.99
    upper = 4.0
    typical = 0.02
    labels: ClassVar[dict[str, str]] = {"step": "coolant leak", "constant": "wrong gain of the coolant valve"}

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`.

        Raises:
            ValueError: the model has no input qc.
        """
        qc = input_of(self, model, "qc").symbol
        return model.substitute(qc, qc * (1 + size))
