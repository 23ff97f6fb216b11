"""Lag of the coolant valve."""

import casadi as ca

from reactorwatch.process.effect import Effect, input_of
from reactorwatch.process.effect_states import add_lag
from reactorwatch.process.model import ProcessModel, variable


class ValveLag(Effect):
    """The real coolant flow follows qc with a time constant of m."""

    name = "valve_lag"
    label = "slow coolant valve"
    location = "coolant"
    unit = "min"
    larger = "coolant flow follows its command with a time constant of {} min"
    lower = 0.0
    upper = 10.0
    typical = 0.1
    start_values = (0.05, 0.5)

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`.

        Raises:
            ValueError: the model has no input qc.
        """
        qc = input_of(self, model, "qc")
        name = f"{self.prefix(model)}.flow"
        state = variable(name, qc.unit, (qc.lower, qc.upper), qc.scale, "flow that the valve lets through")
        _, flow = add_lag(model, state, qc.symbol, size)
        return add_lag(model.substitute(qc.symbol, flow), state, qc.symbol, size)[0]
