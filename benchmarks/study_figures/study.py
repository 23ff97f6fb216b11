"""Common parts of the figures: the model, its steady states, the records, and the models fitted to them.

All records are simulated by this software, each with the seed of the study; what is asked for twice is made once.
"""

from collections.abc import Callable
from functools import cache, cached_property
from typing import Any

import msgspec
import numpy as np

from benchmarks.study_figures import report_scheme
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from plant_node.scenario import Scenario
from reactorwatch.arrays import Array
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.selection import LINEAR_FITS, Model
from reactorwatch.identification.structure import Structure
from reactorwatch.process.library.cstr import OPERATING_COOLANT_FLOW, cstr
from reactorwatch.process.library.cstr_operation import NOISE_SD, OPERATION
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import SteadyState, steady_states
from reactorwatch.records.record import Record

ORDERS = (1, 2, 3)
OUTPUTS = ("C", "T")
NAMES = {"C": "C, mol/l", "T": "T, K", "qc": "qc, l/min"}
TRAINING_ROWS = 1000
"""Fault-free rows at the start of the fault records: 100 minutes."""

_NO_NOISE = {"C": 0.0, "T": 0.0}
IDENTIFICATION_HOLD_MIN, FAST_HOLD_MIN = 1.0, 2.4
_IDENTIFICATION = {"kind": "random-steps", "low": 85.0, "high": 111.0, "hold_min": IDENTIFICATION_HOLD_MIN}
_FAST = {"kind": "random-steps", "low": 90.0, "high": 108.0, "hold_min": FAST_HOLD_MIN}
_ROWS = 4000
_FAST_ROWS = 48_000
FAST_PERIOD_MIN = 0.01


class Study:
    """Model, records and fits of one run of `reproduce`."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    @cached_property
    def model(self) -> ProcessModel:
        """The reactor."""
        return cstr()

    @cached_property
    def simulator(self) -> Simulator:
        """Simulator of the reactor."""
        return Simulator(self.model)

    @cache  # noqa: B019 # a study lives as long as its process
    def points(self, qc: float) -> list[SteadyState]:
        """The steady states at a coolant flow in l/min, from the coldest to the hottest."""
        return steady_states(self.model, np.array([qc]))

    def operating(self, qc: float = OPERATING_COOLANT_FLOW) -> SteadyState:
        """The steady state on the operating branch."""
        return self.points(qc)[-1]

    @cached_property
    def identification(self) -> Record:
        """Record for identification: with the sensors' noise, 0.1 min between rows."""
        return simulate_record(PlantConfig(seed=self.seed, scenario=_IDENTIFICATION), _ROWS)

    @cached_property
    def noise_free(self) -> Record:
        """The simulated record of `identification` without noise."""
        return self.quiet(_IDENTIFICATION)

    @cached_property
    def small_steps(self) -> Record:
        """Record without noise, so close to 100 l/min that the plant is nearly linear."""
        return self.quiet({"kind": "random-steps", "low": 99.9, "high": 100.1, "hold_min": 1.0})

    def quiet(self, scenario: dict[str, Any]) -> Record:
        """A record without noise, 0.1 min between rows, of a scenario as settings have it."""
        return simulate_record(PlantConfig(seed=self.seed, scenario=scenario, noise_sd=_NO_NOISE), _ROWS)

    def fast(self, noise: bool) -> Record:
        """A record of 0.01 min between rows, in which every level is held for `FAST_HOLD_MIN`."""
        config = PlantConfig(seed=self.seed, period_min=FAST_PERIOD_MIN, scenario=_FAST)
        return simulate_record(config if noise else msgspec.structs.replace(config, noise_sd=_NO_NOISE), _FAST_ROWS)

    @property
    def source(self) -> str:
        """Description of the identification record of figures 5, 6 and 11 to 16."""
        record = self.identification
        period = float(np.median(np.diff(record.time_min)))
        low, high, noise = _IDENTIFICATION["low"], _IDENTIFICATION["high"], NOISE_SD
        return (
            f"{record.rows} simulated rows {period:g} min apart, a new coolant flow between {low:g} and {high:g} "
            f"l/min every {IDENTIFICATION_HOLD_MIN:g} min, noise of {noise['C']:g} mol/l and {noise['T']:g} K "
            "(standard deviations)"
        )

    def signals(self, output: str) -> tuple[Array, Array, Array]:
        """Input, output and time of the identification record."""
        record = self.identification
        return record.columns["qc"], record.columns[output], record.time_min

    @cache  # noqa: B019 # as `points`
    def fit(self, family: str, order: int, output: str) -> Model:
        """Fit a model to the first half of the identification record."""
        half = (values[: values.size // 2] for values in self.signals(output))
        return LINEAR_FITS[family](Structure.of_order(order), *half)

    @cache  # noqa: B019 # as `points`
    def report_fit(self, family: str, order: int, output: str) -> LinearModel:
        """Fit a model to the first half of the identification record by the report's scheme; `arx` or `oe`."""
        half = (values[: values.size // 2] for values in self.signals(output))
        return report_scheme.MODELS[family](Structure.of_order(order), *half)

    def spread(self, signal: str) -> float:
        """Standard deviation of a signal over the first half of the identification record, in its unit."""
        values = self.identification.columns[signal]
        return float(np.nanstd(values[: values.size // 2]))

    @cache  # noqa: B019 # as `points`
    def fault_record(self, preset: str) -> Record:
        """One of the four named records."""
        (settings,) = (item.settings for item in OPERATION.presets if item.name == preset)
        return simulate_record(msgspec.convert({"seed": self.seed, **settings}, PlantConfig))


def row_times(rows: int, period_min: float) -> Array:
    """Minutes from 0, shape (rows,)."""
    return np.arange(rows, dtype=np.float64) * period_min


def levels(scenario: Scenario, time_min: Array, seed: int) -> Array:
    """The coolant flow of a scenario at some times, shape (rows,)."""
    return np.array([scenario.level(float(t), seed) for t in time_min])


def edge(holds: Callable[[float], bool], low: float, high: float, precision: float = 1e-3) -> float:
    """Edge of a condition that holds at `low` and not at `high`, by bisection."""
    while high - low > precision:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return 0.5 * (low + high)


def holdout_half(values: Array) -> Array:
    """The half of a record that no model is fitted to."""
    return values[values.size // 2 :]
