"""Stiction of the coolant valve."""

from dataclasses import replace

import casadi as ca

from reactorwatch.process.effect import Effect, input_of
from reactorwatch.process.model import ProcessModel, variable


class ValveStiction(Effect):
    """The valve moves only when qc is more than m away from it; then it goes to qc.

    It moves when a row begins, as qc is constant between rows. The valve's position, as a flow, is a state that jumps
    then and is constant in between. A simulation is the same for all m between two changes of qc that occur in a
    record. So its derivative with respect to m is zero, and a fit has to scan m.
    """

    name = "valve_stiction"
    label = "sticking coolant valve"
    location = "coolant"
    unit = "l/min"
    larger = "valve moves only for changes of more than {} l/min"
    lower = 0.0
    upper = 100.0
    typical = 2.0
    is_discontinuous = True
    start_values = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`.

        Raises:
            ValueError: the model has no input qc.
        """
        qc = input_of(self, model, "qc")
        name = f"{self.prefix(model)}.flow"
        state = variable(name, qc.unit, (qc.lower, qc.upper), self.typical, "flow that the valve stands at")
        free = ca.logic_or(ca.fabs(qc.symbol - state.symbol) > size, size <= 0)
        moved = ca.if_else(free, qc.symbol, state.symbol)
        stuck = model.substitute(qc.symbol, state.symbol)
        # Other states that jump at this row see the new position.
        stuck = replace(stuck, resets=model.substitute(qc.symbol, moved).resets)
        return stuck.with_state(state, ca.SX(0), at_rest=qc.symbol, reset=moved)
