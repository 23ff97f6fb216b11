"""Identify models of one output from a record, and validate them on rows that they have not seen."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, get_args

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, UnfitRecordError, describe_unknown
from reactorwatch.identification.checks import DEFAULT_LAGS, check_record, independence, whiteness
from reactorwatch.identification.data import Dataset, RunPlan, plan_run, rows_of
from reactorwatch.identification.dead_time import DelayChoice, better_structure, name_delays, resolve_delay
from reactorwatch.identification.least_squares import SINGULAR_CONDITION, LeastSquares
from reactorwatch.identification.linear import fit_linear, unscale
from reactorwatch.identification.linear_model import Kind, LinearModel, fit_percent, free_run_percent, simulate
from reactorwatch.identification.polynomial import PolynomialModel, fit_narx, fit_noe, name_product
from reactorwatch.identification.rls import RecursiveLeastSquares
from reactorwatch.identification.structure import Scaling, Structure
from reactorwatch.results.base import Result

FittedModel = LinearModel | PolynomialModel

MODELS: dict[str, Callable[..., FittedModel]] = {
    **{kind: partial(fit_linear, kind) for kind in get_args(Kind)},
    "narx": fit_narx,
    "noe": fit_noe,
}
"""Fits by the kind of model."""

WORST_MINUS_LOG10_P = 6.0  # of a residual test: one in a million true models fails

Coefficients = tuple[float, ...]
InputCoefficients = Coefficients | dict[str, Coefficients]


@dataclass(frozen=True)
class ModelForm:
    """Choice of a model.

    Attributes:
        model: `arx`, `oe`, `armax`, `bj` (Box-Jenkins), `narx` or `noe` (polynomials of degree 2, fitted by one-step
            prediction, and of degree 3, fitted by simulation).
        order: number of lags of the output, of each input and of the disturbance.
        delay: samples from a move of an input to its first effect, at least 1; one by the name of each input; or
            `auto`, which searches them in the rows to fit.
        recursive: whether an ARX model is learned row by row, by recursive least squares, instead of from all rows at
            once.
        forgetting: forgetting factor of recursive least squares, in (0, 1].

    Raises:
        InputError: an unknown kind of model, or a choice that it does not have.
    """

    model: str = "arx"
    order: int = 3
    delay: DelayChoice = 1
    recursive: bool = False
    forgetting: float = 1.0

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise InputError(describe_unknown("model", self.model, MODELS))
        if self.recursive and self.model != "arx":
            raise InputError(f"only arx can be recursive, got {self.model}: leave --recursive out")
        if not self.recursive and self.forgetting != 1.0:
            raise InputError(f"forgetting is of a recursive model, got {self.forgetting:g}: add --recursive")


class Deviations(Result, frozen=True):
    """Standard deviations of the parameters; inf where the rows do not determine them."""

    a: Coefficients
    b: InputCoefficients
    offset: float
    c: Coefficients | None = None
    d: Coefficients | None = None
    f: Coefficients | None = None


class Term(Result, frozen=True):
    """A term of a polynomial.

    Attributes:
        term: factors by signal and lag in rows; `T1*u2` is T[k-1] u[k-2].
        value: coefficient of the term.
        sd: standard deviation of the coefficient.
    """

    term: str
    value: float
    sd: float


class FitPercent(Result, frozen=True):
    """Fits on the held-out rows, 100 (1 - |y - yhat| / |y - mean y|).

    Attributes:
        one_step: fit of the one-step-ahead prediction, for any kind of model.
        free_run: fit of the simulation from the first held-out rows on; -inf if it diverges.
    """

    one_step: float
    free_run: float


class Rmse(Result, frozen=True):
    """Root mean square errors on the held-out rows, in the unit of the output.

    Attributes:
        one_step: error of the one-step-ahead prediction.
        free_run: error of the simulation; inf if it diverges.
    """

    one_step: float
    free_run: float


@dataclass(frozen=True, eq=False)
class HeldOutRun:
    """A model on the held-out rows.

    Attributes:
        time: times of the rows, shape (rows,).
        measured: the output, NaN where nothing was measured.
        one_step: one-step-ahead prediction, NaN where there is none.
        free: simulation, NaN where there is none, inf after it has diverged.
    """

    time: Array
    measured: Array
    one_step: Array
    free: Array


class Identification(Result, frozen=True):
    """A model and how good it is.

    y[k] = a1 y[k-1] + ... + an y[k-n] + b1 u[k-d] + ... + bn u[k-d-n+1] + offset, d the delay, in the signals' own
    units; in an output-error model y stands for the model's own output. An ARMAX model adds e[k] + c1 e[k-1] + ... +
    cn e[k-n], with e its one-step error. A Box-Jenkins model is w + v, w[k] = f1 w[k-1] + ... + b1 u[k-d] + ... +
    offset and v[k] = d1 v[k-1] + ... + e[k] + c1 e[k-1] + ...; it has no a. A polynomial model, NARX or
    output-error, is the sum of its terms and the offset; it has neither a nor b.

    Attributes:
        model: `arx`, `oe`, `armax`, `bj`, `narx` or `noe`.
        order: n.
        delay: delay in samples; by the names of the inputs where they differ.
        output: name of the output.
        rows: number of rows of the fitted part.
        recursive: whether it was learned row by row.
        a: n coefficients of past outputs.
        b: n coefficients of past inputs; of several inputs, by their names.
        offset: the constant.
        sd: standard deviations of the parameters.
        fit_percent: fits on the held-out rows.
        whiteness_minus_log10_p: whiteness test of the residuals of the fitted part: simulation errors of an
            output-error model, one-step errors of the others.
        checks: result of each check by name, "ok" or the reason of its failure.
        c: n coefficients of past errors, of an ARMAX or Box-Jenkins model.
        d: n coefficients of the past disturbance of a Box-Jenkins model.
        f: n coefficients of the plant's own past of a Box-Jenkins model.
        terms: terms of a polynomial model.
        rmse: errors on the held-out rows, where a record was given for validation or rows set the state.
        run: the model on the held-out rows.
    """

    model: str
    order: int
    delay: int | dict[str, int]
    output: str
    rows: int
    recursive: bool
    a: Coefficients
    b: InputCoefficients
    offset: float
    sd: Deviations
    fit_percent: FitPercent
    whiteness_minus_log10_p: float
    checks: dict[str, str]
    c: Coefficients | None = None
    d: Coefficients | None = None
    f: Coefficients | None = None
    terms: tuple[Term, ...] | None = None
    rmse: Rmse | None = None
    run: HeldOutRun | None = None

    python_only: ClassVar = ("run",)

    @property
    def fit(self) -> FitPercent:
        """Another name of `fit_percent`."""
        return self.fit_percent


def identify(
    data: Dataset, form: ModelForm | None = None, validation: Dataset | None = None, settle: int = 0
) -> Identification:
    """Fit a model to the first half of a data set and validate it on the second.

    Args:
        data: the rows.
        form: the kind of model; None: ARX of order 3.
        validation: rows to validate on; then all rows of `data` are fitted. None: the second half.
        settle: number of first held-out rows that may set the state of the simulation, and are left out of the fits.

    Raises:
        InputError: anything that keeps the model from being found, with the cause: an order or delay below 1, too few
            rows, a signal that does not move, inputs that do not excite the order.
    """
    form = form or ModelForm()
    fitted, held_out = data.split(data.rows // 2) if validation is None else (data, validation)
    if form.delay == "auto":
        fitted.check_movement()
    structure = Structure.of_order(form.order, resolve_delay(form.delay, fitted), data.inputs.shape[1])
    _check_rows(structure, form, fitted, held_out, settle)
    fitted.check_movement()
    checks = {check.name: check.result for check in check_record(structure, *fitted.arrays)}
    try:
        model = _fit(structure, form, fitted)
    except InputError as refusal:
        # Where the input is to blame, that is the cause to name.
        excitation = checks.get("excitation", "ok")
        raise refusal if excitation == "ok" else InputError(excitation) from refusal
    residuals = model.residuals(*fitted.arrays)[:, 0]
    of_own_past = {"arx": form.order, "narx": form.order, "oe": 0, "noe": 0}.get(form.model, 2 * form.order)
    lags, white = max(DEFAULT_LAGS, of_own_past + 10), math.nan
    if np.isfinite(residuals).sum() >= 5 * lags:
        white = whiteness(residuals, lags, of_own_past).minus_log10_p
        checks["whiteness"] = _verdict(white, "the residuals are correlated with each other")
        if structure.inputs:
            free = independence(residuals, fitted.inputs, structure.delay, time=fitted.time)
            wrong = "the residuals are correlated with past inputs"
            checks["independence"] = _verdict(free.minus_log10_p, wrong, partial(_other_dead_time, structure, fitted))
    checks["stability"] = _stability(structure, fitted)
    predicted, run = model.predict(*held_out.arrays)[:, 0], free_run(model, held_out, settle)
    predicted[:settle] = np.nan
    y = held_out.output[:, 0]
    values, deviations = _coefficients(model, data)
    return Identification(
        model=form.model,
        order=form.order,
        delay=name_delays(structure.delay, data.input_names),
        output=data.output_name,
        rows=fitted.rows,
        recursive=form.recursive,
        sd=Deviations(**deviations),
        fit_percent=FitPercent(fit_percent(y, predicted), free_run_percent(model, y, run)),
        whiteness_minus_log10_p=white,
        checks=checks,
        rmse=Rmse(_rmse(y, predicted), _rmse(y, run)) if validation is not None or settle else None,
        run=HeldOutRun(held_out.time, y, predicted, run),
        **values,
    )


def free_run(model: FittedModel, data: Dataset, settle: int = 0) -> Array:
    """Simulate a model along a data set.

    A simulation that starts from n measured rows carries their noise along. With more rows the initial state can be
    estimated: for a linear model the simulation is linear in its n initial outputs, and these are fitted to the rows by
    least squares. A model that is not linear starts from the last rows of these.

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


def _check_rows(structure: Structure, form: ModelForm, fitted: Dataset, held_out: Dataset, settle: int) -> None:
    of_noise = {"armax": form.order, "bj": 2 * form.order}.get(form.model, 0)
    least = structure.history + structure.parameters + of_noise
    if fitted.rows <= least:
        raise UnfitRecordError(
            f"order {form.order} with delay {max(structure.delays, default=1)} needs more than {least} rows to fit, "
            f"the first half of the record unless another validates, got {fitted.rows}; "
            "lower the order, or record for longer"
        )
    if settle < 0:
        raise InputError(f"settle must be at least 0 rows, got {settle}")
    first = max(settle, structure.history)
    if held_out.rows <= first:
        raise InputError(f"the held-out part needs more rows than the {first} that set the state, got {held_out.rows}")


def _fit(structure: Structure, form: ModelForm, data: Dataset) -> FittedModel:
    u, y, t = data.arrays
    if not form.recursive:
        return MODELS[form.model](structure, u, y, t)
    scaling = Scaling.of(u, y)
    estimator = RecursiveLeastSquares(structure.parameters, form.forgetting)
    rows = rows_of(structure, scaling.inputs(u), scaling.outputs(y), t)
    for regressor, value in zip(rows.regressors, rows.outputs[:, 0], strict=True):
        estimator.update(regressor, float(value))
    if estimator.condition >= SINGULAR_CONDITION:
        raise UnfitRecordError(f"the rows don't determine {structure.parameters} parameters")
    solution = LeastSquares(
        estimator.parameters,
        estimator.unit_covariance,
        estimator.noise_variance,
        estimator.condition,
        estimator.rows,
    )
    return unscale("arx", structure, scaling, solution)


def _coefficients(model: FittedModel, data: Dataset) -> tuple[dict[str, Any], dict[str, Any]]:
    """Parameters and their standard deviations by the names of the result."""
    if isinstance(model, PolynomialModel):
        products, values, deviations = model.expand()
        names = (name_product(product, model.structure, data.input_names, data.output_name) for product in products)
        terms = tuple(Term(*term) for term in zip(names, _floats(values), _floats(deviations), strict=True))
        none: dict[str, Any] = {
            "a": (),
            "b": dict.fromkeys(data.input_names, ()) if len(data.input_names) > 1 else (),
        }
        return none | {"offset": terms[0].value, "terms": terms[1:]}, none | {"offset": terms[0].sd}
    named = _name(model, data.input_names, model.parameters)
    return named, _name(model, data.input_names, model.standard_deviations)


def _name(model: LinearModel, inputs: tuple[str, ...], values: Array) -> dict[str, Any]:
    """Parameters by the names of the result."""
    order, count, plant = model.structure.output_lags, len(inputs), model.structure.parameters
    by_input = {name: _floats(values[order + i : plant - 1 : count]) for i, name in enumerate(inputs)}
    past = _floats(values[:order])
    parts: dict[str, Any] = {
        "a": past,
        "b": by_input if count > 1 else next(iter(by_input.values()), ()),
        "offset": float(values[plant - 1]),
    }
    if model.kind == "armax":
        parts["c"] = _floats(values[plant:])
    if model.kind == "bj":
        parts |= {
            "a": (),
            "f": past,
            "d": _floats(values[plant : plant + order]),
            "c": _floats(values[plant + order :]),
        }
    return parts


def _rmse(measured: Array, predicted: Array) -> float:
    errors = (measured - predicted)[np.isfinite(measured) & ~np.isnan(predicted)]
    return float(np.sqrt(np.mean(errors**2))) if errors.size else math.nan


def _verdict(minus_log10_p: float, wrong: str, find_cause: Callable[[], str] = str) -> str:
    if minus_log10_p < WORST_MINUS_LOG10_P:
        return "ok"
    cause = find_cause() or "the model leaves something out"
    return f"{wrong}, -log10 p = {minus_log10_p:.1f}: {cause}, and its sd are too small"


def _other_dead_time(structure: Structure, data: Dataset) -> str:
    """Dead times that an ARX model predicts better with; empty if there are none."""
    found = better_structure(structure, data)
    if found is None:
        return ""
    if isinstance(found.delay, int):
        return f"dead time {found.delay} rows, where the model has {structure.delay} (--delay {found.delay})"
    named = [f"{name}={rows}" for name, rows in zip(data.input_names, found.delay, strict=True)]
    return f"dead time {' '.join(named)} rows, where the model has others (--delay {','.join(named)})"


def _stability(structure: Structure, data: Dataset) -> str:
    """Check that the plant is stable, by its ARX model, which alone may have a pole outside the unit circle."""
    try:
        pole = fit_linear("arx", structure, *data.arrays).instability
    except InputError as refusal:
        return f"cannot tell: {refusal}"
    return f"the plant is unstable: its ARX model has {pole}, and a simulation diverges" if pole else "ok"


def _floats(values: Iterable[float]) -> Coefficients:
    return tuple(float(value) for value in values)
