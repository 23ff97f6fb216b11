"""Clogging of a pipe."""

import casadi as ca

from reactorwatch.process.effect import ParameterEffect, make_effect
from reactorwatch.process.model import ProcessModel


class Clogging(ParameterEffect):
    """A pipe lets less through: its outflow coefficient is a (1 - m)."""

    lower = 0.0
    upper = 0.99
    typical = 0.05

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return super().apply(model, -size)


CLOGGINGS = tuple(
    make_effect(
        Clogging,
        f"clog{pipe}",
        f"Clogging of the {text}.",
        __name__,
        location=f"pipe{pipe}",
        label=f"clogging of the {text}",
        larger=f"{{}} % of the {text} clogged",
        parameter=parameter,
    )
    for pipe, parameter, text in (
        (13, "a1", "pipe from tank 1 to tank 3"),
        (20, "a2", "outlet of tank 2"),
        (32, "a3", "pipe from tank 3 to tank 2"),
    )
)
