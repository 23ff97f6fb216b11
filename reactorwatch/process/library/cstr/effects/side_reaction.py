"""Side reaction of A."""

from dataclasses import replace

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel, parameter

REFERENCE_K = 438.54
"""Temperature at which the rate constant of the side reaction is m: that of the operating point."""

ACTIVATION_K = 15e3
"""E2, the side reaction's activation energy over the gas constant. 1.5 times that of A -> B: the selectivity
falls with temperature, so temperature control matters."""

HEAT_K_L_MOL = 100.0
"""Temperature rise per mol/l of A that reacts to D: half of the main reaction's, K1 / k0 = 200."""


class SideReaction(Effect):
    """A also goes to D, at the rate m exp(-E2 (1/T - 1/438.54)) C, and releases heat of its own.

    E2 and the heat are parameters of the extended model, `side_reaction.E2` and `side_reaction.heat`: a record with
    enough excitation identifies them too.
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

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`.

        Raises:
            ValueError: the model has no state C or T.
        """
        prefix = self.prefix(model)
        C, T = (model.states[model.state_index(name)].symbol for name in ("C", "T"))
        E2 = parameter(f"{prefix}.E2", ACTIVATION_K, "K", (0.0, 1e5), "activation energy over R, of A -> D")
        heat = parameter(f"{prefix}.heat", HEAT_K_L_MOL, "K l/mol", (-1e3, 1e3), "heat over rho cp, of A -> D")
        rate = size * ca.exp(-E2.symbol * (1 / T - 1 / REFERENCE_K)) * C
        extended = model.add_rate("C", -rate).add_rate("T", heat.symbol * rate)
        return replace(extended, parameters=(*model.parameters, E2, heat))
