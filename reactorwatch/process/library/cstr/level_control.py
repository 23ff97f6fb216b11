"""The reactor with a variable level: the volume as a state, held by a controller that moves the outflow.

    dV/dt = q - q_out          q_out = max(0, q0 + Kc (V - V_set))

The balances of mass and energy keep their form, because what leaves has the composition and the temperature of the
contents: from d(V C)/dt = q Cf - q_out C - V r follows dC/dt = q/V (Cf - C) - r. What changes is that V is now what the
level is, and that K2, which holds 1/V as a factor, changes with it.

A proportional controller leaves an offset: with a steady inflow q the level rests at V_set + (q - q0) / Kc. The faster
it is, the closer the plant comes to the one of constant volume, which is its limit for Kc -> infinity.
"""

from dataclasses import replace

import casadi as ca

from reactorwatch.process.model import ProcessModel, parameter, variable

GAIN = 5.0
"""Default gain of the level controller, 1/min: a time constant of 12 seconds."""


def with_level_control(model: ProcessModel, gain_per_min: float = GAIN) -> ProcessModel:
    """Make the volume of a model a state.

    Args:
        model: with the parameters `V` and `q`, and `K2` in proportion to 1/V.
        gain_per_min: Kc of the level controller.

    Returns:
        A model with the further state `V` (l), and in place of the parameter `V` the parameters `V_set` (what `V`
        was), `level_gain` and `q0` (the outflow at the set point: what `q` is now).

    Raises:
        ValueError: the model lacks one of these parameters, or the gain is out of its bounds.
    """
    volume, inflow, cooling = (model.parameter(name) for name in ("V", "q", "K2"))
    V = variable("V", "l", (1e-3 * volume.value, 10 * volume.value), 0.1 * volume.value, "volume of the contents")
    V_set = parameter("V_set", volume.value, "l", (volume.lower, volume.upper), "set point of the level controller")
    level_gain = parameter("level_gain", gain_per_min, "1/min", (0.0, 1e4), "of the level controller")
    q0 = parameter("q0", inflow.value, inflow.unit, (0.0, inflow.upper), "outflow at the set point of the level")
    changed = model.substitute(cooling.symbol, cooling.symbol * V_set.symbol / V.symbol)
    changed = changed.substitute(volume.symbol, V.symbol)
    outflow = ca.fmax(q0.symbol + level_gain.symbol * (V.symbol - V_set.symbol), 0)
    return replace(
        changed,
        states=(*model.states, V),
        parameters=(*(item for item in model.parameters if item.name != "V"), V_set, level_gain, q0),
        rhs=(*changed.rhs, inflow.symbol - outflow),
    )
