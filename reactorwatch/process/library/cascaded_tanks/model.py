"""Two tanks, one above the other: a pump fills the upper one, which runs into the lower one, which runs into the basin.

    dx1/dt = k4 u - k1 root(x1)
    dx2/dt = k2 root(x1) - k3 root(x2)

Levels x are what the level sensors show of them, in V, and so is the command u of the pump. Water leaves through a hole
in the bottom as fast as it would fall from its surface (Torricelli), as the root of the level. Only the lower level is
measured. It is the process of the benchmark "Cascaded Tanks" (Schoukens & Noel 2017, Three benchmarks addressing open
challenges in nonlinear system identification, IFAC-PapersOnLine 50(1)); whose upper tank overflows now and then, which
these equations leave out. The constants are round ones of such a rig, about a minute or two to settle; a rig's own are
given as `parameters` in a model's file.

The root has no derivative at an empty tank. Below some hundredths of a volt it goes over into a straight line through
zero, x / (x^2 + s^2)^(1/4), as a slow flow through a hole does (Modelica.Fluid, `regRoot`).
"""

from functools import cache

import casadi as ca

from reactorwatch.process.model import Output, Place, ProcessModel, new_clock, parameter, variable
from reactorwatch.process.places import INPUT, SENSOR, SOURCE

SMALL_LEVEL_V = 0.01
"""Level in V below which its root is replaced by a straight line; at 1 V that changes it by less than 3 in 100,000."""

UPPER_OUTLET = "upper outlet"
"""Name of the term that runs from the upper tank, in V^0.5: the root of its level."""

PLACES = (
    Place("pump", "pump", INPUT, of="u", variables=("u", "x1")),
    Place("upper tank", "upper_tank", SOURCE, of="x1", variables=("x1", "u")),
    Place("lower tank", "lower_tank", SOURCE, of="x2", variables=("x2", "x1")),
    Place("level sensor", "level_sensor", SENSOR, of="x2", variables=("x2",)),
)
"""Places where something unknown may act."""


@cache
def tanks() -> ProcessModel:
    """The tanks with their nominal constants: one model, so that what is compiled from it is compiled once."""
    x1 = variable("x1", "V", (0.0, 50.0), 3.0, "level of the upper tank")
    x2 = variable("x2", "V", (0.0, 50.0), 3.0, "level of the lower tank")
    u = variable("u", "V", (0.0, 10.0), 1.0, "command of the pump", usual=2.5)
    k1 = parameter("k1", 3.0, "V^0.5/min", (0.0, 100.0), "outlet of the upper tank, over its cross-section")
    k2 = parameter("k2", 3.0, "V^0.5/min", (0.0, 100.0), "the same, over the cross-section of the lower tank")
    k3 = parameter("k3", 3.0, "V^0.5/min", (0.0, 100.0), "outlet of the lower tank, over its cross-section")
    k4 = parameter("k4", 3.0, "1/min", (0.0, 100.0), "flow of the pump, over the upper tank's cross-section")
    upper = root(x1.symbol)
    return ProcessModel(
        name="tanks",
        states=(x1, x2),
        inputs=(u,),
        parameters=(k1, k2, k3, k4),
        rhs=(
            k4.symbol * u.symbol - k1.symbol * upper,
            k2.symbol * upper - k3.symbol * root(x2.symbol),
        ),
        outputs=(Output("x2", x2.unit, x2.symbol),),
        clock=new_clock(),
        terms={UPPER_OUTLET: upper},
        places=PLACES,
    )


def root(level: ca.SX, power: ca.SX | None = None) -> ca.SX:
    """The root of a level, or another power; a straight line where it is nearly zero or, on an integrator's way, below.

    Args:
        level: the level in V.
        power: the power; None: 0.5.
    """
    square = level**2 + SMALL_LEVEL_V**2
    return level / (ca.sqrt(ca.sqrt(square)) if power is None else square ** (0.5 - 0.5 * power))
