"""Unmodelled losses: a fraction of a balance's content leaves it, as with any outflow from a mixed vessel.

A loss represents any deviation of the balance itself, for which the catalogue has no effect. Anything that enters a
balance comes from a location of its own.
"""

from collections.abc import Sequence

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel, Variable


def balance_losses(model: ProcessModel) -> Sequence[Effect]:
    """One loss for each state that has a balance, located there."""
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
