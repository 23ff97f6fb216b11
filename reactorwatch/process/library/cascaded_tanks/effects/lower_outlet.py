"""Another power of the level in the flow through the lower tank's outlet."""

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cascaded_tanks.model import root
from reactorwatch.process.model import ProcessModel


class LowerOutlet(Effect):
    """The lower tank's outlet passes k3 x2^(0.5 + m): Torricelli's law has no friction, a long pipe has some."""

    name = "lower_outlet"
    label = "power of the flow through the lower tank's outlet"
    location = "lower_tank"
    unit = "1"
    larger = "flow of the lower outlet grows with a power larger by {}"
    smaller = "flow of the lower outlet grows with a power smaller by {}"
    lower = -0.45
    upper = 0.5
    typical = 0.05

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        level, k3 = model.states[model.state_index("x2")].symbol, model.parameter("k3").symbol
        return model.add_rate("x2", k3 * (root(level) - root(level, 0.5 + size)))
