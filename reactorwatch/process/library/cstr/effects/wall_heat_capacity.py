"""Heat capacity of the vessel's wall."""

import casadi as ca

from reactorwatch.process.effect import Effect, EffectConstant
from reactorwatch.process.model import ProcessModel, variable

EXCHANGE_PER_MIN = 2.0
"""Rate of the wall's temperature, a time constant of half a minute: 8 mm of steel (7800 kg/m3,
500 J/(kg K)) behind a film of 1000 W/(m2 K), as stirred liquids have it."""


class WallHeatCapacity(Effect):
    """A wall with m times the heat capacity of the contents exchanges heat with them.

        dT/dt = ... + m r (Tw - T),    dTw/dt = r (T - Tw)

    r, the exchange, is fitted, too.
    """

    name = "wall_heat_capacity"
    label = "heat stored in the wall"
    location = "energy_balance"
    unit = "1"
    larger = "wall stores {} % of the heat that the contents store"
    lower = 0.0
    upper = 10.0
    typical = 0.05
    constants = (EffectConstant("exchange", EXCHANGE_PER_MIN, 1.0, "1/min", 0.01, 20.0, "how fast the wall follows"),)
    is_traced = False

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        prefix = self.prefix(model)
        inside = model.states[model.state_index("T")]
        bounds = (inside.lower, inside.upper)
        wall = variable(f"{prefix}.temperature", inside.unit, bounds, inside.scale, "temperature of the wall")
        extended, (exchange,) = self.add_constants(model)
        rate = exchange * (inside.symbol - wall.symbol)
        return extended.add_rate("T", -size * rate).with_state(wall, rate, at_rest=inside.symbol)
