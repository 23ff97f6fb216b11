"""Plants with something in them that no catalogue has, integrated by SciPy from equations written out here.

Nothing here comes from `reactorwatch` but the form of a record. An effect adds to the derivatives of the states or
changes the readings; `s` is its size, 0 without it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import copysign, exp, inf, log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from reactorwatch.records.record import Record

Array = NDArray[np.float64]
Rates = Callable[[Sequence[float], Sequence[float], float], list[float]]
"""Derivatives of the states, from states, inputs and the size."""

Reading = Callable[[Array, float], Array]
"""Readings, shape (rows, outputs), from the states, shape (rows, states)."""

PERIOD_MIN = 0.1
TRIES, NEAR = 9, 0.25
"""Trials of a size, and the logarithm of the ratio to the wanted strength that will do."""


def _plain(states: Array, _size: float) -> Array:
    return states


@dataclass(frozen=True)
class Unlisted:
    """An effect that is in no catalogue."""

    name: str  # name in the tables
    places: tuple[str, ...]  # locations that count as right
    forms: tuple[str, ...]  # forms of a law that count as right
    size: float  # size of a trial; the size of a record is scaled from it
    rates: Rates  # derivatives of the states
    process: str = "cstr"  # plant in which it acts
    reading: Reading = _plain  # readings of the sensors
    extra: tuple[float, ...] = ()  # start values of further states


@dataclass(frozen=True)
class Plant:
    """A plant: where it starts, how it is driven, and what its sensors are like."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    start: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    hold_min: float
    noise_sd: tuple[float, ...]


PLANTS = {
    "cstr": Plant(("qc",), ("C", "T"), (0.1, 438.54), (90.0,), (111.0,), 1.0, (0.002, 0.3)),
    "three_tanks": Plant(
        ("Q1", "Q2"), ("h1", "h2", "h3"), (40.0, 20.0, 30.0), (20.0, 15.0), (45.0, 40.0), 3.0, (0.05, 0.05, 0.05)
    ),
}


@dataclass(frozen=True, eq=False)
class UnlistedRecord:
    """A record and the truth about it."""

    record: Record  # measured values
    clean: Array  # readings without noise, shape (rows, outputs)
    size: float  # size of the effect
    widths: float  # largest root mean square difference from the nominal plant, in noise standard deviations


def draw_record(effect: Unlisted, seed: int, wanted_widths: float, span_min: float = 750.0) -> UnlistedRecord:
    """Draw a record in which an effect of this strength acts; few steps of a secant find its size."""
    plant, rng = PLANTS[effect.process], np.random.default_rng([seed, 27])
    time_min = PERIOD_MIN * np.arange(round(span_min / PERIOD_MIN), dtype=np.float64)
    count = int(np.ceil(span_min / plant.hold_min))
    moves = rng.uniform(plant.low, plant.high, (count, len(plant.inputs)))
    rows = np.minimum((time_min / plant.hold_min + 1e-9).astype(int), count - 1)
    inputs, sd = moves[rows], np.array(plant.noise_sd)
    nominal, size = _play(effect, 0.0, time_min, inputs), effect.size
    least, most, near, clean = 0.0, inf, inf, nominal
    for _ in range(TRIES):
        trial = _play(effect, size, time_min, inputs)
        widths = float(np.max(np.sqrt(np.mean((trial - nominal) ** 2, axis=0)) / sd))
        ratio = wanted_widths / widths
        if abs(log(ratio)) < near:
            near, clean, reached = abs(log(ratio)), trial, (size, widths)
        if near < NEAR:
            break
        least, most = (size, most) if ratio > 1.0 else (least, size)
        size = min(size * max(ratio, 0.05), 10.0 * size) if most == inf or least == 0.0 else sqrt(least * most)
    measured = clean + sd * rng.standard_normal(clean.shape)
    columns = dict(zip(plant.inputs, inputs.T, strict=True)) | dict(zip(plant.outputs, measured.T, strict=True))
    return UnlistedRecord(Record(time_min, columns, effect.name), clean, *reached)


def _play(effect: Unlisted, size: float, time_min: Array, inputs: Array) -> Array:
    states = np.empty((time_min.size, len(PLANTS[effect.process].start) + len(effect.extra)))
    x = np.array([*PLANTS[effect.process].start, *effect.extra])
    changes = np.flatnonzero(np.any(np.diff(inputs, axis=0) != 0.0, axis=1)) + 1
    for begin, end in zip([0, *changes], [*changes, time_min.size], strict=True):
        u, to = inputs[begin].tolist(), time_min[end] if end < time_min.size else time_min[-1] + PERIOD_MIN

        def rates(_: float, state: Array, u: list[float] = u) -> list[float]:
            return effect.rates(state.tolist(), u, size)

        solved = solve_ivp(
            rates,
            (time_min[begin], to),
            x,
            method="RK45",
            t_eval=np.append(time_min[begin:end], to),
            rtol=1e-6,
            atol=1e-8,
            max_step=0.5,
        )
        states[begin:end], x = solved.y.T[:-1], solved.y[:, -1]
    return effect.reading(states[:, : len(PLANTS[effect.process].outputs)], size)


def _reactor(change: Callable[[float, float, float, float], tuple[float, float]]) -> Rates:
    """Reactor with further rates of C and T."""

    def rates(x: Sequence[float], u: Sequence[float], size: float) -> list[float]:
        C, T, qc = x[0], x[1], u[0]
        r = 7.2e10 * exp(-1e4 / T) * C
        dC, dT = change(C, T, qc, size) if size else (0.0, 0.0)
        cooling = 0.01 * qc * (1.0 - exp(-700.0 / qc)) * (350.0 - T)
        return [1.0 - C - r + dC, 350.0 - T + 200.0 * r + cooling + dT]

    return rates


def _rate(C: float, T: float) -> float:
    return 7.2e10 * exp(-1e4 / T) * C


def _cooling(T: float, qc: float) -> float:
    return 0.01 * qc * (1.0 - exp(-700.0 / qc)) * (350.0 - T)


def _second_reaction(extra: Callable[[float, float, float], float], heat: float = 200.0) -> Rates:
    """Reactor with a further reaction rate."""

    def change(C: float, T: float, qc: float, size: float) -> tuple[float, float]:
        rate = extra(C, T, size)
        return -rate, heat * rate

    return _reactor(change)


def _heat(extra: Callable[[float, float, float, float], float]) -> Rates:
    return _reactor(lambda C, T, qc, size: (0.0, extra(C, T, qc, size)))


def _mass(extra: Callable[[float, float, float], float]) -> Rates:
    return _reactor(lambda C, T, qc, size: (extra(C, T, size), 0.0))


def _heavier_when_hot(x: Sequence[float], u: Sequence[float], size: float) -> list[float]:
    dC, dT = NOMINAL_REACTOR(x, u, 0.0)
    return [dC, dT / (1.0 + size * (x[1] - 440.0) / 10.0)]


def _preheat_rates(x: Sequence[float], u: Sequence[float], size: float) -> list[float]:
    dC, dT = NOMINAL_REACTOR(x, u, 0.0)
    return [dC, dT + size * (x[2] - 438.54), (x[1] - x[2]) / 1.5]


NOMINAL_REACTOR = _reactor(lambda C, T, qc, size: (0.0, 0.0))


def _bend_temperature(bend: Callable[[Array, float], Array]) -> Reading:
    return lambda x, size: np.column_stack([x[:, 0], x[:, 1] + bend(x[:, 1], size)])


def _bend_concentration(bend: Callable[[Array, float], Array]) -> Reading:
    return lambda x, size: np.column_stack([x[:, 0] + bend(x[:, 0], size), x[:, 1]])


def _hysteresis(T: Array, size: float) -> Array:
    shown, stuck = np.empty_like(T), T[0]
    for row, value in enumerate(T):
        stuck = min(max(stuck, value - size), value + size)
        shown[row] = stuck
    return shown - T


def _root(head: float) -> float:
    return copysign(sqrt(abs(head)), head)


def _tanks(change: Callable[[Sequence[float], Sequence[float], float], tuple[float, float, float]]) -> Rates:
    """Three tanks with further flows into each, cm3/s."""

    def rates(x: Sequence[float], u: Sequence[float], size: float) -> list[float]:
        pipe = 0.5 * sqrt(2.0 * 981.0)
        q13, q32 = 0.46 * pipe * _root(x[0] - x[2]), 0.45 * pipe * _root(x[2] - x[1])
        more = change(x, u, size) if size else (0.0, 0.0, 0.0)
        flows = (u[0] - q13, u[1] + q32 - 0.60 * pipe * _root(x[1]), q13 - q32)
        return [60.0 / 154.0 * (flow + item) for flow, item in zip(flows, more, strict=True)]

    return rates


def _flow_between(first: int, second: int, extra: Callable[[float, float], float]) -> Rates:
    """Three tanks with a further flow from one to another, a function of the difference of levels."""

    def change(x: Sequence[float], u: Sequence[float], size: float) -> tuple[float, float, float]:
        flows = [0.0, 0.0, 0.0]
        by = extra(x[first] - x[second], size)
        flows[first] -= by
        flows[second] += by
        return flows[0], flows[1], flows[2]

    return _tanks(change)


def _flow_into(tank: int, extra: Callable[[Sequence[float], Sequence[float], float], float]) -> Rates:
    def change(x: Sequence[float], u: Sequence[float], size: float) -> tuple[float, float, float]:
        flows = [0.0, 0.0, 0.0]
        flows[tank] = extra(x, u, size)
        return flows[0], flows[1], flows[2]

    return _tanks(change)


def _bent_level(x: Array, size: float) -> Array:
    shown = x[:, :3].copy()
    shown[:, 2] += size * ((shown[:, 2] - 20.0) / 10.0) ** 2
    return shown


REACTOR_ENERGY, REACTION = ("energy_balance",), ("reaction",)
SMOOTH = ("power", "exponential", "difference", "linear")

UNLISTED: tuple[Unlisted, ...] = (
    Unlisted(
        "radiation",
        REACTOR_ENERGY,
        ("power", "difference", "exponential"),
        5.0,
        _heat(lambda C, T, qc, s: -s * ((T / 440.0) ** 4 - (298.0 / 440.0) ** 4)),
    ),
    Unlisted(
        "reversible reaction",
        REACTION,
        ("product", "exponential", "linear", "difference"),
        0.02,
        _second_reaction(lambda C, T, s: -s * exp(-8000.0 * (1.0 / T - 1.0 / 440.0)) * (1.0 - C)),
    ),
    Unlisted(
        "heat capacity grows with T",
        REACTOR_ENERGY,
        ("linear", "exponential", "power", "difference"),
        0.1,
        _heavier_when_hot,
    ),
    Unlisted(
        "evaporation above a threshold",
        REACTOR_ENERGY,
        ("threshold",),
        0.3,
        _heat(lambda C, T, qc, s: -s * max(T - 441.0, 0.0)),
    ),
    Unlisted(
        "feed preheated by the product",
        ("feed", "energy_balance"),
        ("linear", "difference"),
        0.05,
        _preheat_rates,
        extra=(438.54,),
    ),
    Unlisted(
        "thermocouple curve",
        ("temperature_sensor",),
        ("power",),
        0.5,
        NOMINAL_REACTOR,
        reading=_bend_temperature(lambda T, s: s * ((T - 430.0) / 10.0) ** 2),
    ),
    Unlisted(
        "second-order side reaction",
        REACTION,
        ("power", "product", "exponential"),
        2.0,
        _second_reaction(lambda C, T, s: s * exp(-9000.0 * (1.0 / T - 1.0 / 440.0)) * C * C, heat=120.0),
    ),
    Unlisted(
        "reaction inhibited by A",
        REACTION,
        ("saturation", "power", "linear"),
        0.05,
        _second_reaction(lambda C, T, s: _rate(C, T) * (1.0 / (1.0 + s * C / 0.1) - 1.0)),
    ),
    Unlisted(
        "coolant film boils",
        ("coolant",),
        ("linear", "exponential", "power", "product", "difference"),
        0.02,
        _heat(lambda C, T, qc, s: -s * _cooling(T, qc) * (T - 435.0) / 10.0),
    ),
    Unlisted(
        "valve with a curve",
        ("coolant",),
        ("power", "product"),
        0.02,
        _heat(lambda C, T, qc, s: _cooling(T, qc * (1.0 + s * ((qc - 95.0) / 10.0) ** 2)) - _cooling(T, qc)),
    ),
    Unlisted(
        "A evaporates",
        ("mass_balance",),
        ("exponential", "product", "power"),
        0.05,
        _mass(lambda C, T, s: -s * exp(0.06 * (T - 440.0)) * C),
    ),
    Unlisted("A crystallises", ("mass_balance",), ("threshold",), 0.3, _mass(lambda C, T, s: -s * max(C - 0.1, 0.0))),
    Unlisted(
        "analyser saturates",
        ("concentration_sensor",),
        ("saturation", "threshold", "power"),
        0.5,
        NOMINAL_REACTOR,
        reading=_bend_concentration(lambda C, s: -s * np.maximum(C - 0.105, 0.0)),
    ),
    Unlisted(
        "thermometer sticks", ("temperature_sensor",), (), 1.0, NOMINAL_REACTOR, reading=_bend_temperature(_hysteresis)
    ),
    Unlisted(
        "stirrer heats when thick",
        REACTOR_ENERGY,
        ("exponential", "power", "linear", "difference"),
        5.0,
        _heat(lambda C, T, qc, s: s * exp(8.0 * (C - 0.1))),
    ),
    Unlisted(
        "overflow of tank 2",
        ("tank2", "pipe20"),
        ("threshold",),
        1.0,
        _flow_into(1, lambda x, u, s: -s * max(x[1] - 16.0, 0.0)),
        process="three_tanks",
    ),
    Unlisted(
        "laminar pipe beside pipe 13",
        ("pipe13",),
        ("linear", "power", "difference"),
        0.1,
        _flow_between(0, 2, lambda head, s: s * head),
        process="three_tanks",
    ),
    Unlisted(
        "pump 1 gives less against the level",
        ("pump1", "tank1"),
        ("power", "linear", "product"),
        0.02,
        _flow_into(0, lambda x, u, s: -s * u[0] * (x[0] / 40.0) ** 2),
        process="three_tanks",
    ),
    Unlisted(
        "level 3 reads with a curve",
        ("h3",),
        ("power",),
        0.5,
        _tanks(lambda *_: (0.0,) * 3),
        process="three_tanks",
        reading=_bent_level,
    ),
    Unlisted(
        "pipe 32 chokes",
        ("pipe32",),
        ("power", "saturation", "linear", "threshold"),
        0.1,
        _flow_between(2, 1, lambda head, s: -s * max(head, 0.0)),
        process="three_tanks",
    ),
)
"""Even ones are for tuning, odd ones for judging."""
