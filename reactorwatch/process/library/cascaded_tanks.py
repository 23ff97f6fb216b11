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

from reactorwatch.process.effect import Effect, EffectConstant, ParameterEffect
from reactorwatch.process.law import INPUT, SENSOR, SOURCE
from reactorwatch.process.model import Output, Place, ProcessModel, new_clock, parameter, variable
from reactorwatch.process.operation import Example, InputLevels, Operation
from reactorwatch.process.signal_effects import OutputBias

UPPER_OUTLET = "upper outlet"
"""Name of the term that runs from the upper tank, in V^0.5: the root of its level."""

SOFT_V = 0.005
"""Half width of the transition at a brim: where the overflow has a kink it has no derivative, so it sets in within some
hundredths of a volt, as (h + (h^2 + s^2)^(1/2)) / 2 with h the level above the brim."""

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
    square = level**2 + 0.01**2  # straight below 0.01 V; at 1 V that changes the root by less than 3 in 100,000
    return level / (ca.sqrt(ca.sqrt(square)) if power is None else square ** (0.5 - 0.5 * power))


class UpperLeak(Effect):
    """Through a hole in its bottom the upper tank loses m root(x1), which no tank catches."""

    name = "upper_leak"
    label = "leak of the upper tank"
    location = "upper_tank"
    unit = "V^0.5/min"
    larger = "upper tank leaks with {} V^0.5/min"
    lower = 0.0
    upper = 30.0
    typical = 0.1

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return model.add_rate("x1", -size * model.term(UPPER_OUTLET))


class Overflow(Effect):
    """m times the level above the brim runs over: a share of it into the lower tank, the rest beside it.

    The brim and the share that is caught are fitted, too. The larger m is, the closer the level stays to the brim.
    """

    name = "overflow"
    label = "overflow of the upper tank"
    location = "upper_tank"
    unit = "1/min"
    larger = "overflow of {} 1/min of the level above the brim"
    lower = 0.0
    upper = 60.0
    typical = 5.0
    constants = (
        EffectConstant("brim", 10.0, 2.0, "V", 0.1, 50.0, "level of the brim of the upper tank", (6.0, 8.0)),
        EffectConstant(
            "caught", 0.5, 0.3, "1", 0.0, 1.0, "share of the overflow that enters the lower tank", (0.2, 0.8)
        ),
    )

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        extended, (brim, caught) = self.add_constants(model)
        above = model.state("x1") - brim
        twice = above + ca.sqrt(above**2 + SOFT_V**2)
        # k1 and k2 are of one flow over the cross-section of either tank.
        widths = model.parameter("k2").symbol / model.parameter("k1").symbol
        return extended.add_rate("x1", -0.5 * size * twice).add_rate("x2", 0.5 * caught * size * widths * twice)


class LowerOverflow(Effect):
    """m times the level above the brim of the lower tank runs over into the basin.

    The brim is fitted, too.
    """

    name = "lower_overflow"
    label = "overflow of the lower tank"
    location = "lower_tank"
    unit = "1/min"
    larger = "lower tank: overflow of {} 1/min of the level above the brim"
    lower = 0.0
    upper = 60.0
    typical = 5.0
    constants = (
        EffectConstant("brim", 10.0, 2.0, "V", 0.1, 50.0, "level of the brim of the lower tank", (4.0, 6.0, 8.0)),
    )

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        extended, (brim,) = self.add_constants(model)
        above = model.state("x2") - brim
        return extended.add_rate("x2", -0.5 * size * (above + ca.sqrt(above**2 + SOFT_V**2)))


class LowerOutlet(Effect):
    """The lower tank's outlet passes k3 x2^(0.5 + m): Torricelli's law has no friction, a long pipe has some."""

    name = "lower_outlet"
    label = "power of the flow through the lower tank's outlet"
    location = "lower_tank"
    unit = "1"
    larger = "flow of the lower outlet grows with a power larger by {}"
    smaller = "flow of the lower outlet grows with a power smaller by {}"
    lower = -0.45
    upper = 0.5
    typical = 0.05

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        level, k3 = model.state("x2"), model.parameter("k3").symbol
        return model.add_rate("x2", k3 * (root(level) - root(level, 0.5 + size)))


LOCATIONS = {
    "pump": "in the pump",
    "upper_tank": "in the upper tank",
    "lower_tank": "in the lower tank",
    "level_sensor": "in the level sensor",
}
"""Phrases of the locations."""

# fmt: off
EFFECTS: tuple[Effect, ...] = (
    ParameterEffect("k4 (1 + m).", name="pump_gain",
                    label="wrong flow of the pump", location="pump", parameter="k4", typical=0.03,
                    larger="{} % more flow from the pump", smaller="{} % less flow from the pump"),
    UpperLeak(),
    ParameterEffect("The outlet of the upper tank lets (1 - m) of the water through: k1 (1 - m) and k2 (1 - m).",
                    name="outlet_clogging", label="clogged outlet of the upper tank", location="upper_tank",
                    larger="{} % of the outlet of the upper tank clogged", parameter="k1", proportional=("k2",),
                    is_loss=True, lower=0.0, upper=0.99, typical=0.03),
    Overflow(),
    LowerOverflow(),
    LowerOutlet(),
    OutputBias("The measured level is x2 + m.", name="level_bias",
               label="bias of the level sensor", location="level_sensor", output="x2", unit="V",
               larger="level sensor shows {} V too much", smaller="level sensor shows {} V too little",
               lower=-10.0, upper=10.0, typical=0.05, labels={"ramp": "drift of the level sensor"}),
)
# fmt: on
"""Effects in the order of the flow, from the pump to the sensor."""

OPERATION = Operation(
    inputs={"u": InputLevels(level=2.5, low=2.0, high=3.0, swing=0.25, hold_min=5.0)},
    noise_sd={"x2": 0.05},
    fault="upper_leak:step:0.3",
    examples={
        "cascaded_tanks": Example("the upper tank leaks from minute 150 on", ("upper_leak:step:0.1@150min",)),
    },
)
"""The upper tank stays well below its rim, the lower one is neither empty."""
