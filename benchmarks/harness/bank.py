"""The fault bank that the monitor is measured on: faults, sizes and onsets, their records, and runs without a fault.

Every cause that the monitor compares (see `isolation.isolation.causes`) sets in as a step, and three of them as a ramp
too, each in three sizes: small is about the smallest that the oracle (`benchmarks/faults/study.py`) finds within an
hour, medium eight times as much, and large ten times that: as gross as the report's method needs. Large faults that
cool the reactor put it out: that is noted, not avoided.

Every case has a seed of its own, so the fault-free rows before its onset are like no other case's.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from plant_node.scenario import RandomSteps
from reactorwatch.arrays import Array
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import start_state
from reactorwatch.records.record import Record

PERIOD_MIN = 0.1
TRAINING_MIN = 100.0
ONSET_MIN = 300.0
"""The earliest onset; the latest is `ONSET_SPAN_MIN` later."""

ONSET_SPAN_MIN = 10.0
AFTER_MIN = 150.0
"""Duration of a run after the onset; a fault not found by then is not detected."""

RAMP_MIN = 100.0
"""Duration of a ramp from its onset to its size."""

GRADES = ("small", "medium", "large")
BOTH, RISING, FALLING = (1, -1), (1,), (-1,)


@dataclass(frozen=True)
class Fault:
    """A fault of the bank."""

    cause: str  # name of an effect of the catalogue
    profile: str  # `step` or `ramp`
    sizes: tuple[float, float, float]  # small, medium and large, in the effect's unit, above 0
    signs: tuple[int, ...] = BOTH  # signs that its sizes take in turn, from seed to seed

    @property
    def name(self) -> str:
        """Name of the fault in tables."""
        return self.cause if self.profile == "step" else f"{self.cause} {self.profile}"


BANK: tuple[Fault, ...] = (
    Fault("feed_temperature", "step", (0.05, 0.4, 4.0)),
    Fault("feed_concentration", "step", (0.0003, 0.0025, 0.024)),
    Fault("feed_flow", "step", (0.0008, 0.0065, 0.06)),
    Fault("reaction_rate", "step", (0.0016, 0.013, 0.1)),
    Fault("activation_energy", "step", (0.00007, 0.00055, 0.004)),
    Fault("reaction_heat", "step", (0.0003, 0.0025, 0.024)),
    # At 100 l/min the coolant leaves with all but a thousandth of the contents' temperature: more heat transfer does
    # next to nothing, whatever its size.
    Fault("heat_transfer", "step", (0.06, 0.25, 0.6), FALLING),
    Fault("heat_loss", "step", (0.00035, 0.0028, 0.028), RISING),
    Fault("coolant_temperature", "step", (0.05, 0.4, 4.0)),
    Fault("coolant_flow", "step", (0.00055, 0.0045, 0.04)),
    Fault("temperature_bias", "step", (0.065, 0.55, 5.0)),
    Fault("concentration_bias", "step", (0.00045, 0.0036, 0.034)),
    Fault("concentration_gain", "step", (0.0046, 0.038, 0.36)),
    Fault("heat_transfer", "ramp", (0.15, 0.35, 0.7), FALLING),
    Fault("reaction_rate", "ramp", (0.005, 0.025, 0.1), FALLING),
    Fault("temperature_bias", "ramp", (0.2, 1.0, 8.0)),
)

TWINS: dict[str, frozenset[str]] = {
    "feed_temperature": frozenset(
        {"feed_concentration", "reaction_heat", "heat_loss", "coolant_temperature", "coolant_flow"}
    ),
    "feed_concentration": frozenset({"feed_temperature", "feed_flow", "reaction_heat", "heat_loss", "coolant_flow"}),
    "feed_flow": frozenset({"feed_concentration"}),
    "reaction_rate": frozenset({"activation_energy"}),
    "activation_energy": frozenset({"reaction_rate"}),
    "reaction_heat": frozenset({"feed_temperature", "feed_concentration", "heat_loss", "coolant_flow"}),
    "heat_loss": frozenset(
        {"feed_temperature", "feed_concentration", "reaction_heat", "coolant_temperature", "coolant_flow"}
    ),
    "coolant_temperature": frozenset({"feed_temperature", "heat_loss", "coolant_flow"}),
    "coolant_flow": frozenset(
        {"feed_temperature", "feed_concentration", "reaction_heat", "heat_loss", "coolant_temperature"}
    ),
}
"""Causes that imitate each other: of what a small step of one does to both measurements in `AFTER_MIN`, a step of the
other, of the best size, leaves less than a hundredth unexplained (of the sum of squares, each over its noise). A twin
is never counted as the right suspect; how often a twin came first is printed beside it."""


@dataclass(frozen=True)
class Case:
    """One run of the bank."""

    fault: Fault  # the fault
    grade: str  # one of `GRADES`
    size: float  # size with its sign, in the effect's unit
    onset_min: float  # onset in minutes of the plant
    seed: int  # seed of the input and the noise

    @property
    def specification(self) -> str:
        """Specification of the fault for the plant."""
        text = f"{self.fault.cause}:{self.fault.profile}:{self.size!r}@{self.onset_min!r}min"
        return f"{text},end={self.onset_min + RAMP_MIN!r}min" if self.fault.profile == "ramp" else text

    @property
    def rows(self) -> int:
        """Number of rows of the run."""
        return int((self.onset_min + AFTER_MIN) / PERIOD_MIN) + 1


def cases(seeds: int) -> list[Case]:
    """Cases of all faults in all sizes."""
    found = []
    for place, fault in enumerate(BANK):
        for grade, size in zip(GRADES, fault.sizes, strict=True):
            for number in range(seeds):
                seed = 100_000 + 10_000 * place + 1_000 * GRADES.index(grade) + number
                onset_min = ONSET_MIN + ONSET_SPAN_MIN * float(np.random.default_rng(seed).random())
                signed = size * fault.signs[number % len(fault.signs)]
                found.append(Case(fault, grade, signed, round(onset_min, 6), seed))
    return found


SIGNAL = "qc"
OUTPUTS = ("C", "T")
NOISE_SD = np.array([0.002, 0.3])
"""Noise of the measurements of C in mol/l and of T in K; the plant's default."""

EXTINGUISHED_K = 400.0
"""A reactor colder than this has left its operating branch: the unstable branch lies at 401.5 K at 103.41 l/min."""


class Truth(NamedTuple):
    """A run without noise."""

    nominal_states: Array  # states of the plant without the fault, shape (rows, 2)
    nominal: Array  # C and T without the fault, shape (rows, 2)
    faulty: Array  # C and T with the fault as a sensor without noise shows them, shape (rows, 2)
    left_branch: bool  # whether the fault put the reactor out


def record_of(case: Case) -> Record:
    """Record that the plant publishes in a case."""
    return simulate_record(PlantConfig(seed=case.seed, faults=(case.specification,)), case.rows)


def truth_of(case: Case, record: Record) -> Truth:
    """The same run without noise, with the fault and without it."""
    flows = record.columns[SIGNAL]
    start = _start(flows)
    changes = {f"{case.fault.cause}.size": case.size} | profile_changes(case, case.fault.cause)
    nominal = _nominal().run(record.time_min, flows, start)
    faulty = simulator_of(case.fault.cause, case.fault.profile).run(record.time_min, flows, start, changes)
    temperatures = faulty.states[:, list(cstr().state_names).index("T")]
    return Truth(nominal.states, nominal.outputs, faulty.outputs, bool(temperatures.min() < EXTINGUISHED_K))


def measurements_of(record: Record) -> Array:
    """Measurements of C and T, shape (rows, 2)."""
    return np.stack([record.columns[signal] for signal in OUTPUTS], axis=1)


def profile_changes(case: Case, cause: str) -> dict[str, float]:
    """Start and end of a case's profile, as parameters of a model with some cause in it."""
    values = parse_fault(case.specification).values
    return {f"{cause}.{name}": value for name, value in values.items() if name != "size"}


def fault_free(seed: int, rows: int, phi: float = 0.0) -> Record:
    """A run without a fault, with noise that may be autocorrelated."""
    scenario = RandomSteps(90.0, 111.0, 1.0)
    time_min = np.round(np.arange(rows) * PERIOD_MIN, 6)
    flows = np.array([scenario.level(float(minute), seed) for minute in time_min])
    outputs = _nominal().run(time_min, flows, _start(flows)).outputs
    shocks = np.random.default_rng(seed).standard_normal((rows, len(OUTPUTS)))
    shocks[1:] *= np.sqrt(1.0 - phi * phi)  # the first row is as noisy as all others
    outputs = outputs + NOISE_SD * lfilter([1.0], [1.0, -phi], shocks, axis=0)
    columns = {SIGNAL: flows} | {signal: outputs[:, place] for place, signal in enumerate(OUTPUTS)}
    return Record(time_min, columns, f"fault-free run {seed}")


@lru_cache(maxsize=32)
def simulator_of(cause: str, profile: str) -> Simulator:
    """A plant with a fault in it, compiled once for all sizes, onsets and inputs."""
    end = ",end=1min" if profile == "ramp" else ""
    return Simulator(parse_fault(f"{cause}:{profile}:0@0min{end}").extend(cstr()))


@lru_cache(maxsize=1)
def _nominal() -> Simulator:
    return Simulator(cstr())


def _start(flows: Array) -> Array:
    """Initial state of the plant: the steady state of its first input."""
    return start_state(_nominal().model, flows[:1], "operating")
