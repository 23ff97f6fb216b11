"""Operation of the three tanks in closed loop: each pump holds the level of its tank.

With a gain of 5 cm3/s a cm a tank of 154 cm2 follows its set point with a time constant of half a minute; with rows
0.1 min apart the loop is far from its limit of stability (51 cm3/s a cm). The integral action makes a fault visible in
the pumps rather than in the levels. Base flows are those of the steady state at the set points. Dither moves the pumps
about them, so that a record in closed loop informs about the plant.
"""

from reactorwatch.process.controller import Controller
from reactorwatch.process.operation import Example, InputLevels, Operation

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
