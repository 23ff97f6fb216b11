"""Records of the bank: a case with its fault, long runs without one, and the noise-free run of both."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from benchmarks.faults.bank import PERIOD_MIN, Case
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from plant_node.scenario import RandomSteps
from reactorwatch.arrays import Array
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import start_state
from reactorwatch.records.record import Record

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
