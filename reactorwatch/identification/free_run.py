"""Free run of a fitted model from a state that the first rows determine.

A simulation that starts from n measured rows carries their noise along. With more rows the initial state can be
estimated: for a linear model the simulation is linear in its n initial outputs, and these are fitted to the rows by
least squares. A model that is not linear starts from the last rows of these.
"""

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.identification.dataset import Dataset
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.polynomial_narx import PolynomialModel
from reactorwatch.identification.simulation import RunPlan, plan_run, simulate
from reactorwatch.identification.structure import Structure

FittedModel = LinearModel | PolynomialModel


def free_run(model: FittedModel, data: Dataset, settle: int = 0) -> Array:
    """Simulate a model along a data set.

    Args:
        model: the model.
        data: rows that drive it, and set its state.
        settle: number of first rows that may set the state and have no simulated value; the model takes as many as its
            history has at least.

    Returns:
        Shape (rows,); NaN where there is no simulated value, inf after it has diverged.
    """
    history = model.structure.history
    if settle > history and not isinstance(model, LinearModel):
        _, later = data.split(settle - history)
        run = np.full(data.rows, np.nan)
        run[settle - history :] = model.simulate(*later.arrays)[:, 0]
    else:
        run = model.simulate(*data.arrays)[:, 0]
        if settle > history and isinstance(model, LinearModel):
            run += _state_correction(model.structure, model.dynamics, data, run, settle)
    run[:settle] = np.nan
    return run


def _state_correction(structure: Structure, dynamics: Array, data: Dataset, run: Array, settle: int) -> Array:
    """Change of the run by the initial outputs that fit the settling rows best, shape (rows,)."""
    lags, correction = structure.output_lags, np.zeros(data.rows)
    plan = plan_run(structure, *data.arrays)
    starts = np.flatnonzero(plan.starts)
    if starts.size == 0 or starts[0] >= settle:
        return correction
    start = int(starts[0])
    ends = np.flatnonzero(~plan.running[start:])
    end = min(start + int(ends[0]) if ends.size else data.rows, int(starts[1]) if starts.size > 1 else data.rows)
    alone = np.zeros_like(plan.running)
    alone[start:end] = True
    homogeneous = np.zeros_like(dynamics)
    homogeneous[:lags] = dynamics[:lags]
    responses = np.zeros((data.rows, lags))
    for lag in range(1, lags + 1):
        unit = np.zeros((data.rows, 1))
        unit[start - lag] = 1.0
        only_start = RunPlan(np.arange(data.rows) == start, alone)
        response = simulate(structure, homogeneous, np.zeros_like(data.inputs), unit, only_start)[:, 0]
        responses[start:end, lag - 1] = response[start:end]
        responses[start - lag, lag - 1] = 1.0
    errors = np.where(np.arange(data.rows) < start, 0.0, data.output[:, 0] - run)
    rows = np.arange(start - lags, min(settle, end))
    rows = rows[np.isfinite(errors[rows]) & np.isfinite(responses[rows]).all(axis=1)]
    correction[start:end] = responses[start:end] @ np.linalg.lstsq(responses[rows], errors[rows])[0]
    return correction
