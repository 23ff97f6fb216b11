"""Simulation of a linear model: its recursion on its own outputs, driven by the measured inputs."""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.identification.regressor import consecutive_rows
from reactorwatch.identification.structure import Structure

PlanArrays: TypeAlias = tuple[NDArray[np.bool_], NDArray[np.bool_]]

_DIVERGED = 1e100  # a simulation beyond this has diverged


class RunPlan(NamedTuple):
    """Rows of a record that a simulation covers.

    Attributes:
        starts: rows at which the simulation restarts from the measured rows before, shape (rows,).
        running: rows that it covers, shape (rows,).
    """

    starts: NDArray[np.bool_]
    running: NDArray[np.bool_]

    @property
    def arrays(self) -> PlanArrays:
        """Both, for kernels: a class among their arguments would have to stay where it is for their cached code."""
        return self.starts, self.running


def plan_run(
    structure: Structure,
    inputs: NDArray[np.float64],
    outputs: NDArray[np.float64],
    time: ArrayLike | None = None,
) -> RunPlan:
    """Plan the simulation of a record.

    Args:
        structure: structure of the model.
        inputs: shape (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows, 1), NaN where nothing was measured.
        time: shape (rows,); None: gaps are not detected.
    """
    return RunPlan(
        *_plan(
            structure.history,
            consecutive_rows(inputs, time),
            consecutive_rows(np.concatenate([inputs, outputs], axis=1), time),
            consecutive_rows(np.zeros((len(inputs), 1)), time) == 1,
        )
    )


def simulate(
    structure: Structure,
    parameters: NDArray[np.float64],
    inputs: NDArray[np.float64],
    outputs: NDArray[np.float64],
    plan: RunPlan,
) -> NDArray[np.float64]:
    """`LinearModel.simulate` for parameters and signals of any scale, shape (rows, 1).

    Args:
        structure: structure of the model.
        parameters: shape (parameters,).
        inputs: shape (rows, inputs).
        outputs: shape (rows, 1).
        plan: plan for this record and structure.
    """
    theta, u, y = (np.ascontiguousarray(item) for item in (parameters, inputs, outputs[:, 0]))
    return _run(theta, structure.orders, structure.offset, u, y, plan.arrays)[:, None]


@jit
def _plan(
    reach: int, driven: NDArray[np.int64], complete: NDArray[np.int64], after_gap: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Plan from the counts of consecutive rows with inputs (`driven`) and with all values (`complete`)."""
    rows = driven.size
    starts, running = np.zeros(rows, np.bool_), np.zeros(rows, np.bool_)
    for k in range(1, rows):
        # Row k needs the inputs of the rows before it, not its own.
        if after_gap[k] or driven[k - 1] < reach:
            continue
        starts[k] = not running[k - 1] and complete[k - 1] >= reach
        running[k] = running[k - 1] or starts[k]
    return starts, running


@jit
def _run(
    parameters: NDArray[np.float64],
    orders: tuple[int, int, int],
    offset: bool,
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    plan: PlanArrays,
) -> NDArray[np.float64]:
    (output_lags, input_lags, delay), (starts, running) = orders, plan
    rows, inputs = u.shape
    run, own = np.full(rows, np.nan), np.empty(rows)
    for k in range(rows):
        if not running[k]:
            continue
        if starts[k]:
            for back in range(1, output_lags + 1):
                own[k - back] = y[k - back]
        total = parameters[parameters.size - 1] if offset else 0.0
        for lag in range(output_lags):
            total += parameters[lag] * own[k - 1 - lag]
        for lag in range(input_lags):
            for i in range(inputs):
                total += parameters[output_lags + lag * inputs + i] * u[k - delay - lag, i]
        # A diverged simulation stays so: NaN would look like a row without a prediction.
        own[k] = min(max(total, -_DIVERGED), _DIVERGED) if total == total else _DIVERGED
        run[k] = own[k] if abs(own[k]) < _DIVERGED else np.inf
    return run
