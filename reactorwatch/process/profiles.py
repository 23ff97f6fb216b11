"""Profiles: the size m(t) of an effect over time, as an expression of the clock.

All times are minutes of the plant. Before its onset a profile is zero. The free profile has no onset: it is piecewise
linear between knots.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import inf, pi

import casadi as ca

from reactorwatch.process.model import Clock

Expression = Callable[[Clock, dict[str, ca.SX]], ca.SX]


@dataclass(frozen=True)
class ProfileParameter:
    """A parameter of a profile.

    Attributes:
        name: name, such as `onset`.
        unit: unit of its value.
        default: default value; None: required.
        lower: smallest allowed value.
        upper: largest allowed value.
        meaning: a short description.
        breakpoint: whether the profile jumps or has a kink at this time.
    """

    name: str
    unit: str
    default: float | None
    lower: float
    upper: float
    meaning: str
    breakpoint: bool = False


@dataclass(frozen=True)
class Profile:
    """A shape over time.

    Attributes:
        name: name, as in `--fault coolant_flow:step:-0.05@30min`.
        parameters: parameters besides the size.
        expression: function from the clock and the symbols of `size` and the parameters to m(t).
        meaning: a one-line description.
    """

    name: str
    parameters: tuple[ProfileParameter, ...]
    expression: Expression
    meaning: str


def _since(clock: Clock, onset: ca.SX, value: ca.SX) -> ca.SX:
    return ca.if_else(clock.middle >= onset, value, 0)


def _constant(clock: Clock, p: dict[str, ca.SX]) -> ca.SX:
    return p["size"]


def _step(clock: Clock, p: dict[str, ca.SX]) -> ca.SX:
    return _since(clock, p["onset"], p["size"])


def _ramp(clock: Clock, p: dict[str, ca.SX]) -> ca.SX:
    span = ca.fmax(p["end"] - p["onset"], 1e-9)
    rising = _since(clock, p["onset"], p["size"] * (clock.now - p["onset"]) / span)
    return ca.if_else(clock.middle >= p["end"], p["size"], rising)


def _decay(clock: Clock, p: dict[str, ca.SX]) -> ca.SX:
    age = clock.now - p["onset"]
    return _since(clock, p["onset"], p["size"] * (1 - ca.exp(-age / p["time_constant"])))


def _sine(clock: Clock, p: dict[str, ca.SX]) -> ca.SX:
    angle = 2 * pi * (clock.now - p["onset"]) / p["period"] + p["phase"]
    return _since(clock, p["onset"], p["size"] * ca.sin(angle))


_ONSET = ProfileParameter("onset", "min", 0.0, -inf, inf, "when it starts", breakpoint=True)

CONSTANT = Profile("constant", (), _constant, "present from the first row to the last")
STEP = Profile(
    "step",
    (ProfileParameter("onset", "min", None, -inf, inf, "when it starts", breakpoint=True),),
    _step,
    "starts at once and stays",
)
RAMP = Profile(
    "ramp",
    (_ONSET, ProfileParameter("end", "min", None, -inf, inf, "when it reaches its size", breakpoint=True)),
    _ramp,
    "grows evenly from its onset until it reaches its size, and stays",
)
DECAY = Profile(
    "decay",
    (_ONSET, ProfileParameter("time_constant", "min", 60.0, 1e-3, inf, "how fast it approaches its size")),
    _decay,
    "approaches its size exponentially",
)
SINE = Profile(
    "sine",
    (
        _ONSET,
        ProfileParameter("period", "min", 20.0, 1e-3, inf, "from crest to crest"),
        ProfileParameter("phase", "rad", 0.0, -2 * pi, 2 * pi, "angle at the onset"),
    ),
    _sine,
    "swings about zero",
)

FREE_NAME = "free"


@cache
def free_profile(knots: int) -> Profile:
    """Piecewise-linear profile with knots at `time_1`, `time_2`, ..., constant beyond them.

    The size carries the unit; the values `value_1`, ... are shares of it. A fit of the values keeps the size, at one of
    practical significance, and the times of the knots.

    Args:
        knots: number of knots, at least 2; their times must increase.

    Raises:
        ValueError: fewer than 2 knots.
    """
    if knots < 2:
        raise ValueError(f"a free profile must have at least 2 knots, got {knots}")
    numbers = range(1, knots + 1)
    times = (ProfileParameter(f"time_{i}", "min", None, -inf, inf, f"of knot {i}", breakpoint=True) for i in numbers)
    values = (ProfileParameter(f"value_{i}", "1", None, -inf, inf, f"share of the size at knot {i}") for i in numbers)

    def curve(clock: Clock, p: dict[str, ca.SX]) -> ca.SX:
        share = p["value_1"]
        for i in range(1, knots):
            begin, span = p[f"time_{i}"], ca.fmax(p[f"time_{i + 1}"] - p[f"time_{i}"], 1e-9)
            rising = p[f"value_{i}"] + (p[f"value_{i + 1}"] - p[f"value_{i}"]) * (clock.now - begin) / span
            share = ca.if_else(clock.middle >= begin, rising, share)
        return p["size"] * ca.if_else(clock.middle >= p[f"time_{knots}"], p[f"value_{knots}"], share)

    return Profile(FREE_NAME, (*times, *values), curve, "any curve, linear between knots")


FREE = free_profile(12)
"""Enough knots to resemble a step, a ramp, a decay or a sine."""

PROFILES: tuple[Profile, ...] = (CONSTANT, STEP, RAMP, DECAY, SINE, FREE)
