"""Leak of a tank."""

from typing import ClassVar

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.three_tanks.model import leak_name
from reactorwatch.process.model import ProcessModel


class Leak(Effect):
    """A tank loses m s sqrt(2 g h) through a hole: m is the share of a pipe's cross-section that is open."""

    unit = "1"
    lower = 0.0
    upper = 5.0
    typical = 0.05
    tank: ClassVar[int]

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`.

        Raises:
            ValueError: the model has no such tank.
        """
        return model.add_rate(f"h{self.tank}", size * model.term(leak_name(self.tank)))


class Leak1(Leak):
    """Leak of tank 1."""

    name = "leak1"
    location = "tank1"
    label = "leak of tank 1"
    larger = "tank 1 leaks through {} % of a pipe's cross-section"
    tank = 1


class Leak2(Leak):
    """Leak of tank 2."""

    name = "leak2"
    location = "tank2"
    label = "leak of tank 2"
    larger = "tank 2 leaks through {} % of a pipe's cross-section"
    tank = 2


class Leak3(Leak):
    """Leak of tank 3."""

    name = "leak3"
    location = "tank3"
    label = "leak of tank 3"
    larger = "tank 3 leaks through {} % of a pipe's cross-section"
    tank = 3
