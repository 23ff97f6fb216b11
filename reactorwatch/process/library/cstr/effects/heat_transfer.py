"""Change of the heat transfer to the coolant."""

from typing import ClassVar

from reactorwatch.process.effect import ParameterEffect


class HeatTransfer(ParameterEffect):
    """K3 (1 + m): the heat transfer coefficient times the area."""

    name = "heat_transfer"
    label = "changed heat transfer"
    location = "coolant"
    larger = "{} % more heat transfer to the coolant"
    smaller = "{} % of the heat transfer to the coolant lost"
    typical = -0.3
    parameter = "K3"
    labels: ClassVar[dict[str, str]] = {"ramp": "fouling of the jacket", "decay": "fouling of the jacket"}
