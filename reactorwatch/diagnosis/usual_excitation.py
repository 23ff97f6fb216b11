"""A usual excitation of any process, where no record shows one.

Every input steps at random between levels around its usual value (`Variable.usual`; the middle of its bounds where that
is unknown), `STEP_ROWS` rows each, from the stable steady state there. A row is a tenth of the time constant with which
that state is reached, so every process moves at its own speed.
"""

from collections.abc import Mapping

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.process.generic import output_scales, reference_point
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import SteadyState, steady_states
from reactorwatch.records.record import Record

ROWS, STEP_ROWS, SEED = 2000, 10, 1
"""Rows; rows of each level; seed of the levels and of the noise."""

REACH_SCALES = 0.7
"""Largest distance of a level from the usual value, in scales of the input."""

NOISE_SHARE = 0.02
"""Standard deviation of a sensor's noise, in scales of its output."""

ROWS_A_TIME_CONSTANT = 10.0
SHORTEST_PERIOD_MIN, LONGEST_PERIOD_MIN = 1e-3, 10.0


def excite(model: ProcessModel, resolution: Mapping[str, float] | None = None) -> Record:
    """Record of the process with its usual excitation and noise.

    Args:
        model: process model of the plant.
        resolution: smallest step between two values of an output, by name, in its unit; others are continuous.
    """
    usual = np.array(
        [0.5 * (item.lower + item.upper) if item.usual is None else item.usual for item in model.inputs], dtype=float
    )
    rest = _steady_state(model, usual)
    period_min = LONGEST_PERIOD_MIN
    if rest is not None and len(rest.eigenvalues):
        slowest = float(np.min(np.abs(rest.eigenvalues)))
        period_min = 1.0 / (ROWS_A_TIME_CONSTANT * max(slowest, 1e-9))
    time_min = float(np.clip(period_min, SHORTEST_PERIOD_MIN, LONGEST_PERIOD_MIN)) * np.arange(ROWS, dtype=float)
    rng = np.random.default_rng(SEED)
    levels = rng.uniform(-REACH_SCALES, REACH_SCALES, (ROWS // STEP_ROWS, usual.size))
    scales = np.array([item.scale for item in model.inputs])
    bounds = [(item.lower, item.upper) for item in model.inputs]
    lower, upper = np.array(bounds).reshape(-1, 2).T
    inputs: Array = np.clip(usual + scales * np.repeat(levels, STEP_ROWS, axis=0), lower, upper)
    start = reference_point(model)[0] if rest is None else rest.state
    outputs = Simulator(model).run(time_min, inputs, start[: _own_states(model)]).outputs
    outputs = outputs + NOISE_SHARE * np.array(output_scales(model)) * rng.standard_normal(outputs.shape)
    columns = dict(zip((*model.input_names, *model.output_names), np.hstack([inputs, outputs]).T, strict=True))
    for name, step in (resolution or {}).items():
        columns[name] = step * np.round(columns[name] / step)
    return Record(time_min, columns, f"usual excitation of {model.name}")


def _steady_state(model: ProcessModel, usual: Array) -> SteadyState | None:
    stable = [item for item in steady_states(model, usual) if item.stable]
    return stable[-1] if stable else None


def _own_states(model: ProcessModel) -> int:
    return sum(state.name not in model.at_rest for state in model.states)
