"""Identify a model of one output from the first half of a record, and validate it on the second."""

import math
from collections.abc import Iterable
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.errors import InputError
from reactorwatch.identification.batch import SINGULAR_CONDITION, check_not_constant, fit_arx, model_of
from reactorwatch.identification.excitation import check_record
from reactorwatch.identification.linear_model import LinearModel, fit_percent
from reactorwatch.identification.output_error import fit_oe
from reactorwatch.identification.recursive_output_error import RecursiveOutputError
from reactorwatch.identification.regressor import consecutive_rows, rows_of
from reactorwatch.identification.residual_tests import independence, whiteness
from reactorwatch.identification.rls import RecursiveLeastSquares
from reactorwatch.identification.structure import ALL_ROWS, RowChoice, Scaling, Structure, as_columns

MODELS = ("arx", "oe")
WORST_MINUS_LOG10_P = 6.0


class Deviations(msgspec.Struct, frozen=True):
    """Standard deviations of the parameters; inf where the rows do not determine them."""

    a: tuple[float, ...]
    b: tuple[float, ...]
    offset: float


class FitPercent(msgspec.Struct, frozen=True):
    """Fits on the held-out half, 100 (1 - |y - yhat| / |y - mean y|).

    Attributes:
        one_step: fit of the one-step-ahead prediction, for either kind of model.
        free_run: fit of the simulation from the half's first rows on; -inf if it diverges.
    """

    one_step: float
    free_run: float


class Identification(msgspec.Struct, frozen=True):
    """A model and how good it is.

    y[k] = a1 y[k-1] + ... + an y[k-n] + b1 u[k-d] + ... + bn u[k-d-n+1] + offset, d the delay, in the signals' own
    units; in an output-error model y stands for the model's own output.

    Attributes:
        model: "arx" or "oe".
        order: n.
        delay: delay in samples.
        output: name of the output.
        rows: number of rows of the fitted half.
        recursive: whether it was learned row by row.
        a: n coefficients of past outputs.
        b: n coefficients of past inputs.
        offset: the constant.
        sd: standard deviations of the parameters.
        fit_percent: fits on the held-out half.
        whiteness_minus_log10_p: whiteness test of the residuals of the fitted half: one-step errors of an ARX model,
            simulation errors of an output-error model.
        checks: result of each check by name, "ok" or the reason of its failure.
    """

    model: str
    order: int
    delay: int
    output: str
    rows: int
    recursive: bool
    a: tuple[float, ...]
    b: tuple[float, ...]
    offset: float
    sd: Deviations
    fit_percent: FitPercent
    whiteness_minus_log10_p: float
    checks: dict[str, str]

    @property
    def fit(self) -> FitPercent:
        """Another name of `fit_percent`."""
        return self.fit_percent


def identify(
    time: ArrayLike,
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    model: str = "arx",
    order: int = 3,
    delay: int = 1,
    output: str = "y",
    recursive: bool = False,
    forgetting: float = 1.0,
    choice: RowChoice = ALL_ROWS,
    missing: Literal["refuse", "leave out"] = "refuse",
) -> Identification:
    """Fit a model to the first half of a record and validate it on the second.

    Args:
        time: shape (rows,), increasing, in any unit. Rows after a gap are not predicted from rows before it.
        inputs: shape (rows,); the input of a row is held until the next one.
        outputs: shape (rows,).
        model: "arx" or "oe".
        order: n, lags of output and input.
        delay: samples from a move of the input to its first effect, at least 1.
        output: name of the output, for the result.
        recursive: learn row by row instead of from all rows at once.
        forgetting: forgetting factor of the recursive methods, in (0, 1].
        choice: rows of the first half that are fitted; `REPORT_ROWS` is the report's choice.
        missing: treatment of NaN values.

    Raises:
        InputError: anything that keeps the model from being found, with the cause: an unknown model, an order or delay
            below 1, too few rows, missing values, a constant output, an input that does not excite the order.
    """
    t, u, y = _check(time, inputs, outputs, missing)
    if model not in MODELS:
        raise InputError(f"model must be one of {', '.join(MODELS)}, got {model!r}")
    structure = Structure.of_order(order, delay)
    if recursive and model == "oe" and choice != ALL_ROWS:
        raise InputError("a recursive output-error model runs through every row: it cannot choose rows")
    half = len(y) // 2
    if half <= structure.history + structure.parameters:
        raise InputError(
            f"order {order} with delay {delay} needs more than {structure.history + structure.parameters} rows in each "
            f"half, got {len(y)} rows in all"
        )
    fitted, held_out = (u[:half], y[:half], t[:half]), (u[half:], y[half:], t[half:])
    check_not_constant(y[:half])
    checks = {check.name: check.result for check in check_record(structure, *fitted)}
    try:
        found = _fit(structure, model, fitted, recursive, forgetting, choice)
    except InputError as refusal:
        # Where the input is to blame, that is the cause to name.
        excitation = checks.get("excitation", "ok")
        raise refusal if excitation == "ok" else InputError(excitation) from refusal
    residuals = found.residuals(*fitted)[:, 0]
    white = whiteness(residuals, fitted=order if model == "arx" else 0) if _testable(residuals) else None
    if white is not None:
        free = independence(residuals, u[:half], delay, time=t[:half])
        checks["whiteness"] = _verdict(white.minus_log10_p, "the residuals are correlated with each other")
        checks["independence"] = _verdict(free.minus_log10_p, "the residuals are correlated with past inputs")
    values, deviations = found.parameters[0], found.standard_deviations[0]
    return Identification(
        model,
        order,
        delay,
        output,
        half,
        recursive,
        _floats(values[:order]),
        _floats(values[order:-1]),
        float(values[-1]),
        Deviations(_floats(deviations[:order]), _floats(deviations[order:-1]), float(deviations[-1])),
        FitPercent(
            fit_percent(y[half:, 0], found.predict(*held_out)[:, 0]),
            fit_percent(y[half:, 0], found.simulate(*held_out)[:, 0]),
        ),
        math.nan if white is None else white.minus_log10_p,
        checks,
    )


def _check(
    time: ArrayLike, inputs: ArrayLike, outputs: ArrayLike, missing: str
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    t = as_columns(time, "time", 1)
    u, y = as_columns(inputs, "inputs", 1), as_columns(outputs, "outputs", 1)
    if not len(t) == len(u) == len(y):
        raise InputError(f"time, inputs and outputs must have equally many rows, got {len(t)}, {len(u)} and {len(y)}")
    for name, values in (("time", t), ("inputs", u), ("outputs", y)):
        infinite = np.flatnonzero(np.isinf(values[:, 0]))
        absent = np.flatnonzero(np.isnan(values[:, 0]))
        if infinite.size:
            raise InputError(f"{name} must be finite, got {values[infinite[0], 0]} in row {infinite[0] + 1}")
        if absent.size and (missing == "refuse" or name == "time"):
            cure = "" if name == "time" else ": fill it in, or leave such rows out"
            raise InputError(f"{name} must have a value in every row, got NaN in row {absent[0] + 1}{cure}")
    return t[:, 0], u, y


def _fit(
    structure: Structure,
    model: str,
    record: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    recursive: bool,
    forgetting: float,
    choice: RowChoice,
) -> LinearModel:
    u, y, t = record
    if not recursive:
        fit = fit_arx if model == "arx" else fit_oe
        return fit(structure, u, y, t, choice)
    scaling = Scaling.of(u, y)
    if model == "oe":
        running = RecursiveOutputError(structure, scaling, forgetting)
        for k, unbroken_rows in enumerate(consecutive_rows(np.concatenate([u, y], axis=1), t)):
            if unbroken_rows <= 1:
                running.restart()
            if unbroken_rows:
                running.update(u[k], float(y[k, 0]))
        return running.model
    rows = rows_of(structure, scaling.inputs(u), scaling.outputs(y), t, choice)
    estimator = RecursiveLeastSquares(structure.parameters, forgetting)
    for regressor, value in zip(rows.regressors, rows.outputs[:, 0], strict=True):
        estimator.update(regressor, value)
    if not estimator.condition < SINGULAR_CONDITION:
        raise InputError(f"the rows don't determine {structure.parameters} parameters")
    return model_of(structure, scaling, estimator, simulates=False)


def _testable(residuals: NDArray[np.float64]) -> bool:
    """True if there are enough residuals for tests with 20 lags."""
    return int(np.isfinite(residuals).sum()) >= 100


def _verdict(minus_log10_p: float, wrong: str) -> str:
    if minus_log10_p < WORST_MINUS_LOG10_P:
        return "ok"
    return f"{wrong}, -log10 p = {minus_log10_p:.1f}: the model leaves something out, and its sd are too small"


def _floats(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
