"""Deviation of the activation energy."""

from reactorwatch.process.effect import ParameterEffect


class ActivationEnergy(ParameterEffect):
    """E/R (1 + m)."""

    name = "activation_energy"
    label = "wrong activation energy"
    location = "reaction"
    larger = "activation energy higher by {} %"
    smaller = "activation energy lower by {} %"
    lower = -0.5
    upper = 0.5
    typical = 0.002
    parameter = "E_R"
