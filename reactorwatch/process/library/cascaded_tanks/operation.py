"""Operation of the cascaded tanks: the upper tank stays well below its rim, the lower one is neither empty."""

from reactorwatch.process.operation import Example, InputLevels, Operation

OPERATION = Operation(
    inputs={"u": InputLevels(level=2.5, low=2.0, high=3.0, swing=0.25, hold_min=5.0)},
    noise_sd={"x2": 0.05},
    fault="upper_leak:step:0.3",
    examples={
        "cascaded_tanks": Example("the upper tank leaks from minute 150 on", ("upper_leak:step:0.1@150min",)),
    },
)
