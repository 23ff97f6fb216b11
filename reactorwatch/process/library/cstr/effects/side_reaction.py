"""Side reaction of A."""

import casadi as ca

from reactorwatch.process.effect import Effect, EffectConstant
from reactorwatch.process.model import ProcessModel

REFERENCE_K = 438.54
"""Temperature at which the rate constant of the side reaction is m: that of the operating point."""

ACTIVATION_K = 15e3
"""E2, the side reaction's activation energy over the gas constant. 1.5 times that of A -> B: the selectivity
falls with temperature, so temperature control matters."""

HEAT_K_L_MOL = 100.0
"""Temperature rise per mol/l of A that reacts to D: half of the main reaction's, K1 / k0 = 200."""


class SideReaction(Effect):
    """A also goes to D, at the rate m exp(-E2 (1/T - 1/438.54)) C, and releases heat of its own.

    E2 and the heat are fitted, too. Near the main reaction's E/R it is that reaction with another heat.
    """

    name = "side_reaction"
    label = "side reaction"
    location = "reaction"
    unit = "1/min"
    larger = "side reaction of {} 1/min at 438.54 K"
    lower = 0.0
    upper = 20.0
    typical = 0.1
    start_values = (0.02, 0.5)
    is_traced = False
    constants = (
        EffectConstant("E2", ACTIVATION_K, 4e3, "K", 0.0, 1e5, "activation energy over R, of A -> D", (9e3, 19e3)),
        EffectConstant("heat", HEAT_K_L_MOL, 100.0, "K l/mol", -1e3, 1e3, "heat over rho cp, of A -> D", (0.0, 220.0)),
    )

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        C, T = (model.states[model.state_index(name)].symbol for name in ("C", "T"))
        extended, (E2, heat) = self.add_constants(model)
        rate = size * ca.exp(-E2 * (1 / T - 1 / REFERENCE_K)) * C
        return extended.add_rate("C", -rate).add_rate("T", heat * rate)
