"""Heat is lost to the surroundings."""

from dataclasses import replace

import casadi as ca

from reactorwatch.process.effects.base import Effect
from reactorwatch.process.model import ProcessModel

SURROUNDINGS_K = 298.0


class HeatLoss(Effect):
    """-m (T - 298 K) in the energy balance: m is heat transfer coefficient times area over rho cp V."""

    name = "heat_loss"
    label = "heat loss to the surroundings"
    location = "energy_balance"
    unit = "1/min"
    lower = 0.0
    upper = 1.0

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`.

        Raises:
            ValueError: the model has no state T.
        """
        if "T" not in model.state_names:
            raise ValueError(f"heat_loss needs a model with the state 'T', {model.name} has {model.state_names}")
        index = model.state_names.index("T")
        lost = size * (model.states[index].symbol - SURROUNDINGS_K)
        rhs = tuple(item - lost if place == index else item for place, item in enumerate(model.rhs))
        return replace(model, rhs=rhs)
