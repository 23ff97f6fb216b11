"""Clogging of a pipe."""

import casadi as ca

from reactorwatch.process.effect import ParameterEffect
from reactorwatch.process.model import ProcessModel


class Clogging(ParameterEffect):
    """A pipe lets less through: its outflow coefficient is a (1 - m)."""

    unit = "1"
    lower = 0.0
    upper = 0.99
    typical = 0.05

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return super().apply(model, -size)


class Clogging13(Clogging):
    """Clogging of the pipe from tank 1 to tank 3."""

    name = "clog13"
    location = "pipe13"
    label = "clogging of the pipe from tank 1 to tank 3"
    larger = "{} % of the pipe from tank 1 to tank 3 clogged"
    parameter = "a1"


class Clogging20(Clogging):
    """Clogging of the outlet of tank 2."""

    name = "clog20"
    location = "pipe20"
    label = "clogging of the outlet of tank 2"
    larger = "{} % of the outlet of tank 2 clogged"
    parameter = "a2"


class Clogging32(Clogging):
    """Clogging of the pipe from tank 3 to tank 2."""

    name = "clog32"
    location = "pipe32"
    label = "clogging of the pipe from tank 3 to tank 2"
    larger = "{} % of the pipe from tank 3 to tank 2 clogged"
    parameter = "a3"
