"""Lag of the cooling jacket."""

from dataclasses import replace

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.effect_states import add_lag
from reactorwatch.process.library.cstr.model import COOLING
from reactorwatch.process.model import ProcessModel, variable


class JacketLag(Effect):
    """The cooling duty, K2 qc (1 - exp(-K3/qc)) (Tcf - T) in the energy balance, follows this value with a lag of m.

    Other effects on the coolant are part of the value that is followed.
    """

    name = "jacket_lag"
    label = "slow jacket"
    location = "coolant"
    unit = "min"
    larger = "cooling follows with a time constant of {} min"
    lower = 0.0
    upper = 10.0
    typical = 0.1
    start_values = (0.05, 0.5)
    is_traced = False

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        static = model.term(COOLING)
        state = variable(f"{self.prefix(model)}.duty", "K/min", (-1e4, 1e4), 10.0, "what the jacket takes up")
        extended, duty = add_lag(model, state, static, size)
        extended = extended.add_rate("T", duty - static)
        return replace(extended, terms={**extended.terms, COOLING: duty})
