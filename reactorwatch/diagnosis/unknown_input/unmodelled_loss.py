"""What leaves a balance unnoticed: a share of what it holds, as whatever flows out of a mixed vessel takes with it.

It stands for all that may act on a balance as such, where no effect of the catalogue does. What is brought into a
balance instead is brought by something, and that has a place of its own.
"""

from collections.abc import Sequence

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel, Variable


def balance_losses(model: ProcessModel) -> Sequence[Effect]:
    """One for each state that has a balance, located there."""
    return tuple(_loss(state) for state in model.states if state.balance)


def _loss(state: Variable) -> Effect:
    class Loss(Effect):
        """The share m a minute of what is there is lost; where m is negative, gained."""

        name = f"loss of {state.name}"
        label = f"unknown loss from the balance of {state.name}"
        location = state.balance
        unit = "1/min"
        lower = -10.0
        upper = 10.0
        typical = 0.03

        def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
            """See `Effect`."""
            return model.add_rate(state.name, -size * state.symbol)

    return Loss()
