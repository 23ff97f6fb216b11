"""Simulated plants: the reactor, a little different from its model since ever, and sound records of it.

The equations of the differing plants are written out in NumPy and integrated by the classical Runge-Kutta method with
fixed steps, for all plants of a kind alike; the other records are by the product's simulator.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from monitor_node.config import MonitorConfig, ReferenceName
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Encoded, encode
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import start_state
from reactorwatch.records.record import Record
from recorder.tools.player import samples_of

PERIOD_MIN, SPAN_MIN = 0.1, 750.0
NOISE = {"C": 0.002, "T": 0.3}
"""Standard deviations of the sensors' noise, mol/l and K."""
_SUBSTEPS = 10
_START = (0.1, 438.54)


@dataclass(frozen=True)
class Kind:
    """A way in which a sound plant differs from the model."""

    name: str  # description
    constants: tuple[tuple[str, float], ...] = ()  # changed constants of the equations, by name
    lag_min: float = 0.0  # time constant of the coolant valve
    feed_wander: tuple[float, float] | None = None
    process_noise: float = 0.0  # standard deviation of the noise of T's balance, K per square root of a minute
    noise_memory: tuple[float, float] | None = None
    lost: float = 0.0  # share of the rows that are lost
    analyser_every: int = 1  # rows between two values of C
    steps: tuple[float, float] | None = None  # steps of the sensors, mol/l and K


KINDS = (
    Kind("reaction 3 % slower", (("rate", 0.97),)),
    Kind("valve lag of 0.12 min", lag_min=0.12),
    Kind("feed 1 K warmer", (("feed", 351.0),)),
    Kind("3 % more volume", (("volume", 1.03),)),
    Kind("heat loss of 0.003 1/min", (("loss", 0.003),)),
    Kind("feed that wanders", feed_wander=(0.995, 0.15)),
    Kind("process noise", process_noise=0.2),
    Kind("noise with memory", noise_memory=(0.9, 0.15)),
    Kind("2 % of the rows lost", lost=0.02),
    Kind("C every tenth row", analyser_every=10),
    Kind("sensors in steps", steps=(0.001, 0.5)),
)

Input = Callable[[np.random.Generator, int], Array]


def _levels(low: float, high: float, hold_min: float) -> Input:
    def draw(rng: np.random.Generator, rows: int) -> Array:
        hold = round(hold_min / PERIOD_MIN)
        return np.repeat(rng.uniform(low, high, rows // hold + 1), hold)[:rows]

    return draw


INPUTS: dict[str, Input] = {
    "a new flow in 90 to 111 each minute": _levels(90.0, 111.0, 1.0),
    "a new flow in 93 to 109 every 75 min": _levels(93.0, 109.0, 75.0),
    "within 1 l/min, every 2 min": _levels(102.41, 104.41, 2.0),
}


def simulate(kind: Kind, flow: Input, seed: int, warmer_from_min: float | None = None, warmer: float = 1.5) -> Record:
    """Simulate a plant."""
    rng = np.random.default_rng(seed)
    rows = round(SPAN_MIN / PERIOD_MIN)
    time_min: Array = np.arange(rows, dtype=np.float64) * PERIOD_MIN
    qc = flow(rng, rows)
    constants = {"rate": 1.0, "feed": 350.0, "volume": 1.0, "loss": 0.0} | dict(kind.constants)
    feed = np.full(rows, constants["feed"])
    if kind.feed_wander is not None:
        feed += _ar(rng, rows, *kind.feed_wander)
    if warmer_from_min is not None:
        feed[time_min >= warmer_from_min - 1e-9] += warmer
    kicks = kind.process_noise * np.sqrt(PERIOD_MIN) * rng.normal(size=rows)
    C, T = _integrate(qc, feed, constants, kind.lag_min, kicks)
    noise_T = rng.normal(0.0, NOISE["T"], rows) if kind.noise_memory is None else _ar(rng, rows, *kind.noise_memory)
    columns = {"qc": qc, "C": C + rng.normal(0.0, NOISE["C"], rows), "T": T + noise_T}
    if kind.steps is not None:
        for name, step in zip(("C", "T"), kind.steps, strict=True):
            columns[name] = np.round(columns[name] / step) * step
    if kind.analyser_every > 1:
        columns["C"][np.arange(rows) % kind.analyser_every != 0] = np.nan
    kept = rng.uniform(size=rows) >= kind.lost
    return Record(time_min[kept], {name: values[kept] for name, values in columns.items()}, kind.name)


def _ar(rng: np.random.Generator, rows: int, coefficient: float, innovation: float) -> Array:
    """AR(1) in its stationary state, shape (rows,)."""
    values = np.empty(rows)
    values[0] = rng.normal(0.0, innovation / np.sqrt(1.0 - coefficient**2))
    shocks = rng.normal(0.0, innovation, rows)
    for k in range(1, rows):
        values[k] = coefficient * values[k - 1] + shocks[k]
    return values


def _integrate(
    qc: Array, feed: Array, constants: dict[str, float], lag_min: float, kicks: Array
) -> tuple[Array, Array]:
    """C and T of each row; the input of a row is held until the next, and the noise is added at its end."""
    through, rate, loss = 1.0 / constants["volume"], constants["rate"], constants["loss"]
    step = PERIOD_MIN / _SUBSTEPS
    decays = [float(np.exp(-share * step / lag_min)) if lag_min else 0.0 for share in (0.5, 1.0)]

    def slope(C: float, T: float, flow: float, Tf: float) -> tuple[float, float]:
        reaction = rate * 7.2e10 * C * np.exp(-1e4 / T)
        cooling = 0.01 * through * flow * (1.0 - np.exp(-700.0 / flow)) * (350.0 - T)
        return through * (1.0 - C) - reaction, through * (Tf - T) + 200.0 * reaction + cooling - loss * (T - 298.0)

    states = np.empty((len(qc), 2))
    C, T = _START
    real = float(qc[0])
    for k, (command, Tf) in enumerate(zip(qc.tolist(), feed.tolist(), strict=True)):
        states[k] = C, T
        for _ in range(_SUBSTEPS):
            middle, end = (command + (real - command) * decay for decay in decays)
            a = slope(C, T, real if lag_min else command, Tf)
            b = slope(C + 0.5 * step * a[0], T + 0.5 * step * a[1], middle, Tf)
            c = slope(C + 0.5 * step * b[0], T + 0.5 * step * b[1], middle, Tf)
            d = slope(C + step * c[0], T + step * c[1], end, Tf)
            real = end
            C += step / 6.0 * (a[0] + 2.0 * b[0] + 2.0 * c[0] + d[0])
            T += step / 6.0 * (a[1] + 2.0 * b[1] + 2.0 * c[1] + d[1])
        T += float(kicks[k])
    return states[:, 0], states[:, 1]


def messages_of(record: Record, plant: str = "cstr") -> list[Encoded]:
    """Messages of a record, as its plant publishes them."""
    return [encode(item) for item in samples_of(record, plant)]


TRAINING_MIN = 100.0
FLOWS = {
    "wide": (1.0, 90.0, 111.0),
    "mid": (1.0, 97.0, 109.0),
    "moves": (75.0, 93.0, 109.0),
    "sines": (0.0, 93.0, 109.0),
}
"""Inputs of sound records: minutes between two new levels, and their range; three sines within it."""

NOISE_SD = {"none": (0.0, 0.0), "low": (0.0005, 0.05), "medium": (0.002, 0.3), "high": (0.005, 1.0)}
"""Levels of noise: standard deviations of C in mol/l and of T in K."""


def _flows_of(kind: str, rows: int, rng: np.random.Generator) -> Array:
    time_min = np.arange(rows) * PERIOD_MIN
    every, low, high = FLOWS[kind]
    if kind == "sines":
        phases = rng.uniform(0.0, 2.0 * np.pi, 3)
        waves = zip((3.0, 3.0, 2.0), (3.1, 7.7, 19.0), phases, strict=True)
        return np.asarray(101.0 + sum(a * np.sin(2 * np.pi * time_min / period + phase) for a, period, phase in waves))
    index = (time_min / every).astype(int)
    return np.asarray(rng.uniform(low, high, index[-1] + 1)[index])


def sound_record(kind: str, noise: str, seed: int, span_min: float) -> Record:
    """Record of a sound reactor under a kind of input, with a level of noise."""
    rng, rows = np.random.default_rng(seed), round(span_min / PERIOD_MIN)
    time_min, flows = np.round(np.arange(rows) * PERIOD_MIN, 6), _flows_of(kind, rows, rng)
    outputs = Simulator(cstr()).run(time_min, flows, start_state(cstr(), flows[:1], "operating")).outputs
    outputs = outputs + np.array(NOISE_SD[noise]) * rng.standard_normal(outputs.shape)
    return Record(time_min, {"qc": flows, "C": outputs[:, 0], "T": outputs[:, 1]}, f"{kind}, {noise} noise, {seed}")


def without_equations(reference: ReferenceName = "auto") -> MonitorConfig:
    """Settings of a monitor that knows the names of the reactor's signals only."""
    return MonitorConfig(
        process="",
        inputs=("qc",),
        outputs=("C", "T"),
        reference=reference,
        training_min=TRAINING_MIN,
        false_alarms_per_30_days=30.0,
        isolation=False,
        smallest_sd={},
        priorities={},
    )
