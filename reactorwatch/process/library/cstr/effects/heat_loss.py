"""Heat loss to the surroundings."""

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

SURROUNDINGS_K = 298.0


class HeatLoss(Effect):
    """-m (T - 298 K) in the energy balance: m is heat transfer coefficient times area over rho cp V."""

    name = "heat_loss"
    label = "heat loss to the surroundings"
    location = "energy_balance"
    unit = "1/min"
    larger = "contents cool towards their surroundings at a rate of {} 1/min"
    lower = 0.0
    upper = 1.0
    typical = 0.01

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        T = model.states[model.state_index("T")].symbol
        return model.add_rate("T", -size * (T - SURROUNDINGS_K))
