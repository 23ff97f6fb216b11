"""A linear tank, for which the information of an experiment is known in closed form."""

from math import exp

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis
from reactorwatch.process.effect import Effect, ParameterEffect, ParameterShift
from reactorwatch.process.model import Output, ProcessModel, new_clock, parameter, variable
from reactorwatch.records.record import Record

RATE, PERIOD_MIN, NOISE_SD = 0.5, 0.1, 0.2
"""1/min, min, and m."""

NOISE = Noise((NOISE_SD,), (0.0,))


def tank() -> ProcessModel:
    """dh/dt = RATE (gain u + shift - h)."""
    h = variable("h", "m", (-100.0, 100.0), 1.0, "level")
    u = variable("u", "m", (0.0, 20.0), 1.0, "what the level tends to")
    gain = parameter("gain", 1.0, "1", (0.0, 10.0), "of the input")
    shift = parameter("shift", 0.0, "m", (-10.0, 10.0), "of the input")
    rhs = RATE * (gain.symbol * u.symbol + shift.symbol - h.symbol)
    return ProcessModel(
        "tank", (h,), (u,), (gain, shift), (ca.SX(rhs),), (Output("h", "m", h.symbol),), clock=new_clock()
    )


class Gain(ParameterEffect):
    """Gain (1 + m)."""

    name, label, location, unit, lower, upper, typical = "gain", "wrong gain", "feed", "1", -0.9, 5.0, 0.1
    parameter = "gain"


class Shift(ParameterShift):
    """Shift + m."""

    name, label, location, unit, lower, upper, typical = "shift", "wrong shift", "feed", "m", -10.0, 10.0, 0.1
    parameter = "shift"


def explained(effect: Effect, size: float, run: Run) -> FittedHypothesis:
    """A hypothesis of one effect that is there all the time."""
    hypothesis = Hypothesis(FaultFilter(tank(), (effect,), NOISE), (Constant(run.time_min),))
    return FittedHypothesis(hypothesis, hypothesis.evaluate(run, [np.array([size])]), 0.0)


def record(u: Array) -> Run:
    """Noise-free record of a tank without fault."""
    return Run(PERIOD_MIN * np.arange(u.size, dtype=np.float64), u[:, None], follows(u, u[0])[:, None])


def follows(u: Array, start: float) -> Array:
    """The level, row by row: an input held for a period is approached exponentially."""
    kept, h = exp(-RATE * PERIOD_MIN), [start]
    for held in u[:-1].tolist():
        h.append(kept * h[-1] + (1.0 - kept) * held)
    return np.array(h)


LEVELS = np.repeat([4.0, 7.0, 3.0, 6.0, 2.0, 8.0, 5.0, 4.0, 6.0, 3.0], 60)


def tank_record(noise_sd: float = NOISE_SD, gain: float = 1.0) -> Record:
    """Record of a tank whose input has another gain."""
    level = follows(gain * LEVELS, gain * LEVELS[0]) + noise_sd * np.random.default_rng(1).standard_normal(LEVELS.size)
    return Record(PERIOD_MIN * np.arange(LEVELS.size, dtype=np.float64), {"u": LEVELS, "h": level}, "tank")
