"""The scheme of the original report: its least squares, its output-error iteration, and its limits of three sigma.

The report fits an ARX model y[k] = a1 y[k-1] + ... + an y[k-n] + b1 u[k-1] + ... + bn u[k-n] by the pseudo-inverse of
every 6th row from the 100th on, with lags in samples of the fast clock. Where these rows do not determine the
parameters, the pseudo-inverse gives the solution of least norm. The report scales its signals and does not give the
factors; here each signal is centred on its mean and divided by its standard deviation, and the model is converted back
to the signals' own units.

Its output-error model is fitted by the same formula, with the model's own simulated output in place of the measured
one. The output of a model satisfies that model exactly, so the formula returns the model that made it: every ARX model
is a fixed point, and the report's output-error model is its ARX model, simulated. `fit_output_error` iterates all the
same, because rows that do not determine the parameters can move it once.

A fault is reported where the residual leaves mean +- 3 sigma of the training's residuals.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.arrays import Array
from reactorwatch.errors import UnfitRecordError
from reactorwatch.identification.data import Rows, ScaledRecord
from reactorwatch.identification.least_squares import LeastSquares
from reactorwatch.identification.linear import unscale
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.structure import Structure, as_columns

ORDER = 3
"""Order of the model that the report finds best."""
SKIP, EVERY = 99, 6
"""The report fits every 6th row from the 100th on, with lags of the fast clock."""
WIDTH = 3.0
"""Width of its limits, in standard deviations."""
MOST_STEPS = 20
"""Steps after which an iteration that has not settled ends."""
_SETTLED = 1e-9


def report_rows(rows: Rows) -> Rows:
    """Those of the rows that the report fits."""
    taken = (rows.position >= SKIP) & ((rows.position - SKIP) % EVERY == 0)
    return Rows(rows.regressors[taken], rows.outputs[taken], rows.position[taken])


def fit_least_squares(
    structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None
) -> LinearModel:
    """Fit the report's ARX model."""
    return _solve(ScaledRecord.of(structure, inputs, outputs, time))


def fit_output_error(
    structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None
) -> LinearModel:
    """Fit the report's output-error model: its ARX model, re-estimated from its own simulation until it settles.

    Arguments are those of `fit_least_squares`.
    """
    model = fit_least_squares(structure, inputs, outputs, time)
    for _ in range(MOST_STEPS):
        following = re_estimate(model, inputs, outputs, time)
        change = np.abs(following.parameters - model.parameters).max()
        model = following
        if change <= _SETTLED * np.abs(model.parameters).max():
            break
    return model


def re_estimate(
    model: LinearModel, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None
) -> LinearModel:
    """Fit a model to the simulation of a model: one step of the report's output-error iteration.

    Arguments are the model that is simulated, and those of `fit_least_squares`; the measured outputs give the
    simulation its first rows and the model its noise.
    """
    u = as_columns(inputs, "inputs", model.structure.inputs)
    y = as_columns(outputs, "outputs", 1)
    run = model.simulate(u, y, time)
    if np.isinf(run).any():
        raise UnfitRecordError(
            "the report's output-error iteration simulates its ARX model, and that simulation diverges: take a lower "
            "order or a record with less noise"
        )
    record = ScaledRecord.of(model.structure, u, y, time)
    fitted = _solve(replace(record, y=record.scaling.outputs(run)))
    errors = (y - run)[np.isfinite(y - run)]
    unknown, noise_sd = np.full_like(fitted.covariance, np.inf), float(np.std(errors))
    return replace(fitted, kind="oe", covariance=unknown, noise_sd=noise_sd)


@dataclass(frozen=True, eq=False)
class ReportChart:
    """The report's chart of an output."""

    model: LinearModel  # the model of the training
    mean: float  # mean of the residuals of the training, in the output's unit
    sd: float  # their standard deviation
    residuals: Array  # residuals of all rows, shape (rows,); NaN where a row cannot be predicted
    out: np.ndarray[tuple[int], np.dtype[np.bool_]]  # flags of the rows outside the limits, shape (rows,)

    @property
    def limits(self) -> tuple[float, float]:
        """Lower and upper limit, in the output's unit."""
        return self.mean - WIDTH * self.sd, self.mean + WIDTH * self.sd


MODELS: dict[str, Callable[..., LinearModel]] = {"arx": fit_least_squares, "oe": fit_output_error}
"""The report's fits by the kind of model."""


def chart_output(
    inputs: ArrayLike, output: ArrayLike, time: ArrayLike, training_rows: int, model: str = "oe", order: int = ORDER
) -> ReportChart:
    """Chart an output by the report's scheme."""
    u, y, t = as_columns(inputs, "inputs"), as_columns(output, "output", 1), np.asarray(time, dtype=np.float64)
    structure = Structure.of_order(order, inputs=u.shape[1])
    fitted = MODELS[model](structure, u[:training_rows], y[:training_rows], t[:training_rows])
    residuals = fitted.residuals(u, y, t)[:, 0]
    learned = residuals[:training_rows][np.isfinite(residuals[:training_rows])]
    if learned.size < 2:
        raise UnfitRecordError(
            f"the report's limits need two rows of training that can be predicted, got {learned.size}"
        )
    mean, sd = float(learned.mean()), float(learned.std(ddof=1))
    return ReportChart(fitted, mean, sd, residuals, np.abs(residuals - mean) > WIDTH * sd)


def _solve(record: ScaledRecord) -> LinearModel:
    """Least squares of least norm on the report's rows, as a model in the signals' own units."""
    structure, rows = record.structure, report_rows(record.rows())
    regressors = rows.regressors[:, : structure.parameters - int(structure.offset)]
    if not len(regressors):
        raise UnfitRecordError(
            f"the report's scheme takes every {EVERY}th row from row {SKIP + 1} on, and "
            f"none of these is complete with the {structure.history} rows before it: {len(record.y)} rows are too few"
        )
    singular = np.linalg.svd(regressors, compute_uv=False)
    smallest = max(regressors.shape) * np.finfo(np.float64).eps
    inverse = np.linalg.pinv(regressors, rcond=smallest)
    parameters = inverse @ rows.outputs
    squares = np.sum((rows.outputs - regressors @ parameters) ** 2, axis=0)
    rank = int(np.sum(singular > smallest * singular[0]))
    free = len(regressors) - rank
    whole = rank == regressors.shape[1]
    solution = LeastSquares(
        parameters=np.pad(parameters[:, 0], (0, int(structure.offset))),
        inverse=np.pad(inverse @ inverse.T, (0, int(structure.offset)))
        if whole
        else np.full((structure.parameters,) * 2, np.inf),
        noise_variance=float(squares[0]) / free if free > 0 else np.inf,
        condition=float(singular[0] / singular[-1]) if singular[-1] > 0.0 else np.inf,
        rows=len(regressors),
    )
    return unscale("arx", structure, record.scaling, solution)
