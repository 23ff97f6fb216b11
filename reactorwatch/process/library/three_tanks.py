"""Three tanks in a row, joined by pipes: one pump fills each outer tank, and the second tank drains into the basin.

    A dh1/dt = Q1 - Q13        Q13 = a1 s root(h1 - h3)
    A dh2/dt = Q2 + Q32 - Q20  Q32 = a3 s root(h3 - h2)
    A dh3/dt = Q13 - Q32       Q20 = a2 s root(h2)           root(h) = sign(h) sqrt(2 g |h|)

Levels h are in cm, flows in cm3/s, and the model's time is in minutes. A is the cross-section of a tank, s that of a
pipe, a1, a2 and a3 are outflow coefficients (Torricelli).

It is the laboratory plant DTS200 (Amira GmbH), a benchmark of fault diagnosis; constants as in the data set
"Three-Tank System" (zhuofupan, 2021). Published records were made in closed loop, in which a fault is mainly visible in
the pumps.

The root has no derivative at zero. Below a tenth of a millimetre it becomes a straight line through zero,
h / (h^2 + s^2)^(1/4), as a slow flow through a hole does (Modelica.Fluid, `regRoot`).
"""

from functools import cache
from typing import ClassVar

import casadi as ca

from reactorwatch.process.effect import Effect, ParameterEffect
from reactorwatch.process.law import FACTOR, SENSOR, SOURCE
from reactorwatch.process.model import Output, Place, ProcessModel, new_clock, parameter, variable
from reactorwatch.process.operation import Controller, Example, InputLevels, Operation
from reactorwatch.process.signal_effects import InputOffset, OutputBias

PLACES = (
    Place("pipe13", "pipe13", FACTOR, flows={"h1": "flow 13", "h3": "inflow 13"}, variables=("head 13",)),
    Place("pipe32", "pipe32", FACTOR, flows={"h3": "flow 32", "h2": "inflow 32"}, variables=("head 32",)),
    Place("pipe20", "pipe20", FACTOR, flows={"h2": "flow 20"}, variables=("h2",)),
    *(
        Place(f"pump{i}", f"pump{i}", FACTOR, flows={f"h{i}": f"pump {i}"}, variables=(f"Q{i}", f"h{i}"))
        for i in (1, 2)
    ),
    *(Place(f"tank{i}", f"tank{i}", SOURCE, of=f"h{i}", variables=(f"h{i}",)) for i in (1, 2, 3)),
    *(Place(f"h{i}", f"h{i}", SENSOR, of=f"h{i}", variables=(f"h{i}",)) for i in (1, 2, 3)),
)
"""Places where something unknown may act; a pipe takes from one tank what it gives to another."""


@cache
def three_tanks() -> ProcessModel:
    """The tanks with their nominal constants: one model, so that what is compiled from it is compiled once."""
    h1, h2, h3 = (
        variable(f"h{i}", "cm", (0.0, 62.0), 5.0, f"level of tank {i}", balance=f"tank{i}") for i in (1, 2, 3)
    )
    Q1, Q2 = (
        variable(f"Q{i}", "cm3/s", (0.0, 150.0), 5.0, f"flow of pump {i}", usual=usual)
        for i, usual in ((1, 21.4), (2, 53.8))
    )
    A = parameter("A", 154.0, "cm2", (1.0, 1e5), "cross-section of a tank")
    s = parameter("s", 0.5, "cm2", (1e-3, 1e3), "cross-section of a pipe")
    g = parameter("g", 981.0, "cm/s2", (900.0, 1000.0), "acceleration of gravity")
    a1 = parameter("a1", 0.46, "1", (0.0, 2.0), "outflow coefficient of the pipe from tank 1 to tank 3")
    a2 = parameter("a2", 0.60, "1", (0.0, 2.0), "outflow coefficient of the outlet of tank 2")
    a3 = parameter("a3", 0.45, "1", (0.0, 2.0), "outflow coefficient of the pipe from tank 3 to tank 2")

    def pipe(coefficient: ca.SX, head: ca.SX) -> ca.SX:
        return coefficient * s.symbol * ca.sqrt(2 * g.symbol) * signed_root(head)

    Q13 = pipe(a1.symbol, h1.symbol - h3.symbol)
    Q32 = pipe(a3.symbol, h3.symbol - h2.symbol)
    Q20 = pipe(a2.symbol, h2.symbol)
    per_min = 60.0 / A.symbol  # of a flow a second
    levels = (h1, h2, h3)
    return ProcessModel(
        name="three_tanks",
        states=levels,
        inputs=(Q1, Q2),
        parameters=(A, s, g, a1, a2, a3),
        rhs=(
            per_min * (Q1.symbol - Q13),
            per_min * (Q2.symbol + Q32 - Q20),
            per_min * (Q13 - Q32),
        ),
        outputs=tuple(Output(level.name, level.unit, level.symbol) for level in levels),
        clock=new_clock(),
        terms={
            **{leak_name(i): -per_min * pipe(ca.SX(1), level.symbol) for i, level in enumerate(levels, start=1)},
            "pump 1": per_min * Q1.symbol,
            "pump 2": per_min * Q2.symbol,
            "flow 13": -per_min * Q13,
            "inflow 13": per_min * Q13,
            "flow 32": -per_min * Q32,
            "inflow 32": per_min * Q32,
            "flow 20": -per_min * Q20,
            "head 13": h1.symbol - h3.symbol,
            "head 32": h3.symbol - h2.symbol,
        },
        places=PLACES,
    )


def leak_name(tank: int) -> str:
    """Name of the term that a leak with an opening of 1 adds to a tank's level, in cm/min."""
    return f"leak {tank}"


def signed_root(head: ca.SX) -> ca.SX:
    """Root of a difference of levels with its sign, and a straight line where it is nearly zero."""
    # Straight below 0.01 cm; at 1 cm that changes the root by 3 in 100,000.
    return head / ca.sqrt(ca.sqrt(head**2 + 0.01**2))


class Leak(Effect):
    """A tank loses m s sqrt(2 g h) through a hole: m is the share of a pipe's cross-section that is open."""

    unit = "1"
    lower = 0.0
    upper = 5.0
    typical = 0.05
    tank: ClassVar[int]

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return model.add_rate(f"h{self.tank}", size * model.term(leak_name(self.tank)))


# fmt: off
EFFECTS: tuple[Effect, ...] = (
    *(
        InputOffset(f"The real flow of pump {i} is Q{i} + m.", name=f"pump{i}",
                    label=f"wrong flow of pump {i}", location=f"pump{i}", input=f"Q{i}", unit="cm3/s",
                    larger=f"{{}} cm3/s more from pump {i}", smaller=f"{{}} cm3/s less from pump {i}",
                    lower=-150.0, upper=150.0, typical=1.0)
        for i in (1, 2)
    ),
    *(
        OutputBias(f"The measured level of tank {i} is h{i} + m.", name=f"h{i}.bias",
                   label=f"bias of the level sensor of tank {i}", location=f"h{i}", output=f"h{i}",
                   larger=f"level sensor of tank {i} shows {{}} cm too much",
                   smaller=f"level sensor of tank {i} shows {{}} cm too little",
                   unit="cm", lower=-62.0, upper=62.0, typical=1.0,
                   labels={"ramp": f"drift of the level sensor of tank {i}"})
        for i in (1, 2, 3)
    ),
    *(
        Leak(f"Leak of tank {i}.", name=f"leak{i}", label=f"leak of tank {i}", location=f"tank{i}", tank=i,
             larger=f"tank {i} leaks through {{}} % of a pipe's cross-section")
        for i in (1, 2, 3)
    ),
    *(
        ParameterEffect(f"Clogging of the {text}.", name=f"clog{pipe}", label=f"clogging of the {text}",
                        location=f"pipe{pipe}", parameter=coefficient, is_loss=True,
                        larger=f"{{}} % of the {text} clogged", lower=0.0, upper=0.99, typical=0.05)
        for pipe, coefficient, text in (
            (13, "a1", "pipe from tank 1 to tank 3"),
            (20, "a2", "outlet of tank 2"),
            (32, "a3", "pipe from tank 3 to tank 2"),
        )
    ),
)
# fmt: on
"""Pumps, sensors, tanks, pipes."""

SET_POINTS_CM = {"h1": 40.0, "h2": 20.0}
BASE_FLOWS_CM3_S = {"Q1": 31.86, "Q2": 27.56}

OPERATION = Operation(
    inputs={
        pump: InputLevels(level=flow, low=flow - 8.0, high=flow + 8.0, swing=4.0, hold_min=2.0)
        for pump, flow in BASE_FLOWS_CM3_S.items()
    },
    noise_sd={"h1": 0.05, "h2": 0.05, "h3": 0.05},
    fault="leak1:step:0.05",
    examples={
        "three_tanks": Example(
            "the pipe between tanks 1 and 3 is clogged by 20 % from minute 150 on", ("clog13:step:0.2@150min",)
        )
    },
    controllers=tuple(
        Controller(
            input=pump,
            output=level,
            set_point=SET_POINTS_CM[level],
            gain=-5.0,
            base=BASE_FLOWS_CM3_S[pump],
            integral_time_min=2.0,
            dither=True,
        )
        for pump, level in zip(BASE_FLOWS_CM3_S, SET_POINTS_CM, strict=True)
    ),
)
"""Operation in closed loop: each pump holds the level of its tank.

With a gain of 5 cm3/s a cm a tank of 154 cm2 follows its set point with a time constant of half a minute; with rows
0.1 min apart the loop is far from its limit of stability (51 cm3/s a cm). The integral action makes a fault visible in
the pumps rather than in the levels. Base flows are those of the steady state at the set points. Dither moves the pumps
about them, so that a record in closed loop informs about the plant.
"""
