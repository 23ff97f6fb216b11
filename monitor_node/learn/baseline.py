"""Baseline of a plant, learned from the rows of its training: the reference, and the distribution of its residuals.

The noise of the process model is estimated, or a model is fitted to the rows, as the settings ask. Disturbed intervals
are left out. The prewhitening is learned from the remaining residuals. A training with too much disturbance is refused.

A signal with too few values is left out with the reason, and the others are monitored. The identified models predict
without the inputs that are left out.
"""

from collections.abc import Callable
from itertools import compress
from math import log, log10
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import regular_intervals
from monitor_node.learn import arx_fit
from monitor_node.learn.arx import ArxReference, arx_structure
from monitor_node.learn.black_box_reference import BlackBoxReference
from monitor_node.learn.process_reference import ProcessReference
from monitor_node.learn.references import Reference
from monitor_node.learn.training_rows import (
    AfterMoves,
    RowArrays,
    Screening,
    TrainingRows,
    compare_after_moves,
    screen_baseline,
)
from monitor_node.watched_process import possible_ranges
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Check
from reactorwatch.errors import InputError
from reactorwatch.identification.structure import Structure
from reactorwatch.kalman.noise_estimation import resolution_sd
from reactorwatch.process.model import ProcessModel
from reactorwatch.spc.averages import ewma
from reactorwatch.spc.extrapolation import FittedExtrapolation, average_inputs, fit_extrapolation
from reactorwatch.spc.prewhitening import LARGEST_ORDER, Prewhitening, learn
from reactorwatch.spc.step_test import ROWS as STEP_ROWS

FEWEST_ROWS = 50
"""Least number of residuals; the training continues until there are as many."""

FEWEST_SPARSE = 20
"""The same for an output with values in less than half of the rows, such as a laboratory's, judged by equations: they
leave no coefficients to estimate from it, and limits allow for a standard deviation known to a sixth."""

MINOR = 0.2
"""Share of the smallest relevant standard deviation (of the filter: of the residual's) below which a deviation of a few
times as much does not make an interval disturbed."""

NO_VALUE = "no value of it has come"
"""Reason for leaving a signal without values out."""

ERRS = (
    "the residuals are errors of the black box, not noise: limits follow from the largest of them, and nothing is "
    "learned after the training"
)
"""Remark on a reference that errs."""

LARGER = 1.1
"""Ratio of averages of errors up to which chance explains it: their standard deviations are known to a tenth from 1,000
rows. On the reactor a black box has 0.1 to 1.05 times the averages of ARX models, on plants of others 1.3 to 4."""

NOTHING_LEARNED = Prewhitening(0.0, (), 1.0, FEWEST_ROWS, 0.5 / FEWEST_ROWS, 0.0)
"""Prewhitening of an output that is left out and not evaluated."""


class TrainingResult(NamedTuple):
    """Result of a training.

    Attributes:
        rows: rows of the training.
        reference: reference for the rows to come.
        learned: prewhitening of its residuals, one an output.
        z: residuals as the reference normalises them, shape (n, outputs); NaN if missing.
        e: the same, prewhitened.
        measured: outputs in undisturbed rows, shape (n, outputs); NaN elsewhere.
        values: all signals, the inputs first, shape (n, inputs + outputs); NaN where disturbed or left out. Unlike
            `measured` it has rows that could not be predicted.
        checks: checks of the training.
        refused: reason to start again; empty if the training is usable.
        left_out: signals that cannot be monitored, with the reason.
        responses: response of each residual to a lasting step of one unit of its output, shape (outputs, rows); NaN
            where there is no model; None for equations.
        outliers: number of single values of each output that were left out.
        after_moves: size of the residuals after moves of the inputs, those that were left out too; as usual for
            equations, whose limits allow for what is not known of the response to a move.
        weakness: reason why the training did not determine how the plant follows the inputs; empty if it did.
        extrapolation: how residuals grow with the distance of the inputs; None: they do not.
    """

    rows: TrainingRows
    reference: Reference
    learned: list[Prewhitening]
    z: Array
    e: Array
    measured: Array
    values: Array
    checks: list[Check]
    refused: str
    left_out: dict[str, str]
    responses: Array | None
    outliers: list[int]
    after_moves: AfterMoves
    weakness: str
    extrapolation: FittedExtrapolation | None

    def widen(self, factor: float, e: Array) -> "TrainingResult":
        """The same with limits that are wider by a factor, from other prewhitened residuals."""
        learned = [replace(item, sd=item.sd * factor) for item in self.learned]
        after_moves = self.after_moves._replace(size=max(self.after_moves.size / factor, 1.0))
        return self._replace(learned=learned, e=e / factor, after_moves=after_moves)

    def excess_rate(self, arl0: float, alarms: int) -> float:
        """Times as many false alarms as promised, by what the training shows of moves of the inputs.

        Where it did not determine the dynamics, each new set point may raise alarms, and the next may come within the
        length of the training: one event, however many of the alarms it raises.
        """
        once = arl0 / (len(self.z) * max(alarms, 1))
        return max(self.after_moves.excess_rate(arl0), once if self.weakness else 0.0)


def fewest_values(config: MonitorConfig, model: ProcessModel | None) -> int:
    """Least number of values of each output that a training needs."""
    structure = arx_structure(config)
    of_one_input = replace(structure, inputs=min(structure.inputs, 1), delay=max(structure.delays, default=1))
    return FEWEST_ROWS if model is not None else max(arx_fit.fewest_rows(of_one_input), FEWEST_ROWS)


def needed_values(count: int, rows: int, fewest: int, *, by_equations: bool) -> int:
    """Least number of values or predictions of an output that has some count of them in a training."""
    return FEWEST_SPARSE if by_equations and count < rows / 2 else fewest


def learn_baseline(
    config: MonitorConfig, model: ProcessModel | None, models: ArxReference, rows: TrainingRows, *, last_chance: bool
) -> TrainingResult:
    """Learn a baseline from the rows of a training.

    Args:
        config: settings of the monitor.
        model: process model; None: the reference is a model that is fitted to the rows.
        models: identified models, which are fitted, and judge after the training if they are chosen.
        rows: the rows.
        last_chance: True to use the training even if it is disturbed.
    """
    choice, outputs = _Choice(config, models, rows, has_model=model is not None), config.outputs
    (time_min, inputs, measured), left_out = choice.rows, choice.left_out
    reference, z, screenings = choice.choose(model)
    if not reference.follows_equations:
        left_out |= _too_few_values(config.inputs, inputs)
    left_out |= _too_few_residuals(outputs, z, choice.rows, left_out, by_equations=reference.follows_equations)
    evaluated = [name not in left_out for name in outputs]
    refused = _refusal(outputs, screenings, evaluated)
    if not any(evaluated):
        refused = "; ".join(map(": ".join, left_out.items()))
    elif refused and last_chance:
        refused, screenings = "", _keep_all(z)
    usable = np.column_stack([item.usable for item in screenings]) & np.array(evaluated)
    disturbed = np.column_stack([item.left_out for item in screenings]) | ~np.array(evaluated)
    all_z, z = z, np.where(usable, z, np.nan)
    order = 0 if reference.errs else LARGEST_ORDER
    smallest = [sd / typical for sd, typical in zip(choice.smallest, reference.typical_sd, strict=True)]
    learned, e = _learn_prewhitening(z, smallest, evaluated, order)
    extrapolation: FittedExtrapolation | None = None
    if reference.is_identified and config.inputs and not config.has_values_only:
        extrapolation = fit_extrapolation(average_inputs(choice.given.inputs), e, config.chart_settings["ewma_weight"])
    if extrapolation is not None:
        all_z, z = all_z / extrapolation.sds[:, None], z / extrapolation.sds[:, None]
        learned, e = _learn_prewhitening(z, smallest, evaluated, order)
    after_moves, weakness = AfterMoves(), choice.weakness
    if not reference.follows_equations:
        weakness = _few_moves(config.inputs, inputs) or weakness
        if any(evaluated):
            columns = [
                np.where(screenings[i].single, np.inf, _prewhiten(all_z[:, i], learned[i]))
                for i in np.flatnonzero(evaluated)
            ]
            after_moves = compare_after_moves(np.column_stack(columns), inputs)
    found = {"training": [refused or _screening_summary(outputs, time_min, screenings, evaluated) or "ok"]}
    found[BlackBoxReference.kind] = [weakness] if weakness else []
    if reference.errs:
        found[BlackBoxReference.kind].append(ERRS)
    if choice.without_black_box and config.reference == "black-box":
        found[BlackBoxReference.kind].append(f"the ARX models judge: {choice.without_black_box}")
    if reference.is_identified:
        arx_fit.start_judging(models, choice.given, extrapolation)
        found["model"] = _simplifications(outputs, models, evaluated)
    found["signals"] = [f"{name} is left out: {why}" for name, why in left_out.items()]
    inputs = np.where([name not in left_out for name in config.inputs], inputs, np.nan)
    return TrainingResult(
        rows=rows,
        reference=reference,
        learned=learned,
        z=z,
        e=e,
        measured=np.where(usable, measured, np.nan),
        values=np.hstack([inputs, np.where(disturbed, np.nan, measured)]),
        checks=[Check(name=name, result=text) for name, texts in found.items() for text in texts],
        refused=refused,
        left_out=left_out,
        responses=reference.step_responses(STEP_ROWS),
        outliers=[item.outliers for item in screenings],
        after_moves=after_moves,
        weakness=weakness,
        extrapolation=extrapolation,
    )


class _Candidate(NamedTuple):
    """A reference, the normalised residuals of the training, shape (n, outputs), and their screening."""

    reference: Reference
    z: Array
    screenings: list[Screening]


class _Choice:
    """Choice of the reference; arguments as for `learn_baseline`.

    Attributes:
        rows: rows of the training; outputs that cannot be monitored are NaN.
        given: the same, with 0 for inputs that have too few values.
        steps: resolution of each output; 0 if it has none.
        smallest: smallest standard deviation of each output.
        left_out: outputs that cannot be monitored, with the reason.
        weakness: reason why the training did not determine how the plant follows the inputs; empty if it did.
        without_black_box: reason why there is no black box; empty if there is, or it was not wanted.
    """

    def __init__(self, config: MonitorConfig, models: ArxReference, rows: TrainingRows, *, has_model: bool) -> None:
        self._config, self._models, outputs = config, models, config.outputs
        self.rows = rows.arrays
        columns = list(zip(outputs, self.rows.outputs.T, strict=True))
        self.steps = [resolution_sd(column, config.resolution.get(name)) for name, column in columns]
        self.smallest = [
            max(config.smallest_sd.get(name, 0.0), sd, 1e-12) for name, sd in zip(outputs, self.steps, strict=True)
        ]
        self.left_out = _too_few_values(outputs, self.rows.outputs, by_equations=has_model) | self._constant_outputs()
        self.rows.outputs[:, [name in self.left_out for name in outputs]] = np.nan
        has_values = np.count_nonzero(np.isfinite(self.rows.inputs), axis=0) >= FEWEST_ROWS
        self.given = self.rows._replace(inputs=np.where(has_values, self.rows.inputs, 0.0))
        self._has_all_inputs = bool(has_values.all())
        self.weakness = self.without_black_box = ""

    def _constant_outputs(self) -> dict[str, str]:
        """Outputs that never vary, and have no smallest relevant deviation in the settings, with the reason."""
        return {
            name: f"it reads {np.nanmax(column):.6g} in the whole training; train on rows in which it changes, or "
            "state its smallest_sd or resolution"
            for name, column, step in zip(self._config.outputs, self.rows.outputs.T, self.steps, strict=True)
            if not step and not self._config.smallest_sd.get(name) and np.isfinite(column).any()
        }

    def choose(self, model: ProcessModel | None) -> _Candidate:
        """Fit the references that the settings allow, and choose one."""
        wanted, models = self._config.reference, self._models
        if not self._has_all_inputs:
            arx_fit.learn_again(models, self.given)
        identified = self._fit(lambda rows: (models, arx_fit.fit_models(models, rows)), self.given)
        equations = self._fit_equations(model) if model is not None and self._has_all_inputs else None
        if equations is not None and (wanted == "equations" or _predicts_as_well(equations, identified)):
            return equations
        is_driven = bool(self._config.inputs and self._has_all_inputs)  # without inputs there is nothing to simulate
        # after fewer, too many values of the inputs are unfamiliar to a black box, and it judges too few rows
        is_long = len(self.rows.time_min) >= 200
        fitted = [delay for predictor in models.predictors for delay in predictor.structure.delays]
        delays = fitted or models.structure.delays or (1,)
        has_one_delay = max(delays) - min(delays) <= 1  # to a row, as the search is; a black box has one for all inputs
        black_box = None
        if wanted == "black-box" or (wanted == "auto" and is_driven and is_long and has_one_delay):
            black_box = self._fit_black_box(min(delays))
            if black_box is not None and wanted == "black-box":
                self.weakness = black_box.reference.weakness
                return black_box
        if self._config.has_values_only:  # the models stay as fitted
            return identified
        judging = models.copy()
        found = self._fit(lambda rows: (judging, arx_fit.fit_models(judging, rows, to_judge=True)), self.given)
        if black_box is not None and not black_box.reference.weakness and self._errs_less(black_box, found):
            return black_box
        models.predictors[:] = judging.predictors
        return found._replace(reference=models)

    def _errs_less(self, black_box: _Candidate, identified: _Candidate) -> bool:
        """True if the averages of a black box's errors in held-out rows are no larger than those of the ARX models.

        What charts with a memory see of a model are not its errors from row to row, but those that last.
        """
        reference = black_box.reference
        assert isinstance(reference, BlackBoxReference)
        errors = np.stack([reference.held_out, identified.z])
        errors = errors[:, np.isfinite(errors).any(axis=2).all(axis=0)]
        weight = float(self._config.chart_settings["ewma_weight"])
        sizes = np.sqrt(np.mean(np.square(ewma(np.nan_to_num(errors), weight)), axis=1))
        known = np.isfinite(errors).any(axis=(0, 1))
        ratio = np.log(np.maximum(sizes[0], 1e-300)) - np.log(np.maximum(sizes[1], 1e-300))
        return float(np.mean(ratio[known])) <= log(LARGER)

    def _fit_equations(self, model: ProcessModel) -> _Candidate | None:
        """Fit the filter of a process model; None if too many values are impossible: it is another process."""
        columns, ranges = np.column_stack(self.rows[1:]), possible_ranges(self._config, model)
        lower, upper = np.array([(item.lower, item.upper) for item in ranges]).T
        out = np.isfinite(columns) & ((columns < lower) | (columns > upper))
        if self._config.reference != "equations" and np.any(np.mean(out, axis=0) > 1.0 / 3.0):
            return None
        inputs, outputs = np.hsplit(np.where(out, np.nan, columns), [len(self._config.inputs)])
        possible = RowArrays(self.rows.time_min, inputs, outputs)

        def fit(rows: RowArrays) -> tuple[Reference, Array]:
            found = ProcessReference.fit(model, self._config.outputs, rows, self.smallest)
            return found, found.run(possible)

        return self._fit(fit, possible)

    def _fit_black_box(self, delay: int) -> _Candidate | None:
        """Fit a black box; None if the rows do not allow it."""

        def fit(rows: RowArrays) -> tuple[Reference, Array]:
            return BlackBoxReference.learn(rows, self.rows.outputs, self.smallest, delay)

        try:
            return self._fit(fit, self.given)
        except InputError as error:
            self.without_black_box = str(error)
            return None

    def _fit(self, fit: Callable[[RowArrays], tuple[Reference, Array]], rows: RowArrays) -> _Candidate:
        """Fit a reference, screen its normalised residuals, and fit it again without disturbed rows."""
        reference, z = fit(rows)
        if reference.is_identified:  # its residuals have the unit of the output
            minor = [max(MINOR * sd, step) for sd, step in zip(self.smallest, self.steps, strict=True)]
        else:
            minor = [max(MINOR, step / sd) for sd, step in zip(reference.typical_sd, self.steps, strict=True)]
        screenings = [screen_baseline(column, sd) for column, sd in zip(z.T, minor, strict=True)]
        is_clean = not any(item.disturbed_intervals or item.outliers for item in screenings)
        if not is_clean and not any(item.refused for item in screenings):
            kept = np.column_stack([item.usable for item in screenings]) | ~np.isfinite(z)
            again = fit(rows._replace(outputs=np.where(kept, rows.outputs, np.nan)))
            if not (reference.errs and (again[0].errs or _largest_correlation(again[1]) > 0.3)):
                return _Candidate(*again, screenings)
        if reference.errs:  # what looks disturbed are its errors
            screenings = _keep_all(z)
        return _Candidate(reference, z, screenings)


def _largest_correlation(z: Array) -> float:
    """Largest correlation of a residual with that of the row before: about 0 for noise, 0.5 and more for errors."""
    columns = [np.nan_to_num(column) for column in z.T if np.isfinite(column).any()]
    return max((float(column[1:] @ column[:-1] / (column @ column)) for column in columns), default=0.0)


def _keep_all(z: Array) -> list[Screening]:
    """Screening of residuals that leaves nothing out."""
    none = np.zeros(len(z), dtype=np.bool_)
    return [Screening(known, [], [], none, none) for known in np.isfinite(z).T]


def _learn_prewhitening(
    z: Array, smallest_sd: list[float], evaluated: list[bool], order: int
) -> tuple[list[Prewhitening], Array]:
    """Prewhitening of each residual, and the residuals prewhitened, shape (n, outputs)."""
    learned = [
        learn(column, sd, order) if is_evaluated else NOTHING_LEARNED
        for column, sd, is_evaluated in zip(z.T, smallest_sd, evaluated, strict=True)
    ]
    return learned, np.column_stack([_prewhiten(column, item) for column, item in zip(z.T, learned, strict=True)])


def _prewhiten(z: Array, learned: Prewhitening) -> Array:
    e = z - learned.constant
    for lag, coefficient in enumerate(learned.coefficients, start=1):
        e[lag:] -= coefficient * z[:-lag]
        e[:lag] = np.nan
    return np.asarray(e / learned.sd)


def _simplifications(outputs: tuple[str, ...], models: ArxReference, evaluated: list[bool]) -> list[str]:
    """Terms that the identified models lack, each with the outputs."""
    lacking: dict[str, list[str]] = {}
    for name, predictor in compress(zip(outputs, models.predictors, strict=True), evaluated):
        lacking.setdefault(_simplification(predictor.structure, models.structure), []).append(name)
    least = arx_fit.ROWS_A_PARAMETER
    return [
        f"{', '.join(names)}: predicted with {text}, as there are fewer than {least} rows a parameter"
        for text, names in lacking.items()
        if text
    ]


def _simplification(has: Structure, wanted: Structure) -> str:
    """Terms that a structure lacks; empty: none."""
    parts = []
    if has.output_lags < wanted.output_lags:
        parts.append(f"{has.output_lags} instead of {wanted.output_lags} lags of the output")
    if has.inputs < wanted.inputs:
        parts.append("no input")
    elif has.inputs and has.input_lags < wanted.input_lags:
        parts.append(f"{has.input_lags} instead of {wanted.input_lags} lags of the inputs")
    return " and ".join(parts)


def _few_moves(names: tuple[str, ...], inputs: Array) -> str:
    """Reason why the training cannot show how the outputs follow an input that hardly ever moved; empty if it can."""
    counts = [_count_moves(column[np.isfinite(column)]) for column in inputs.T]
    few = [f"{name} ({count}; 5 are needed)" for name, count in zip(names, counts, strict=True) if 0 < count < 5]
    if not few:
        return ""
    return (
        f"the training has too few moves of {', '.join(few)}: at other set points false alarms may be more than "
        "promised; train over more set points"
    )


def _count_moves(values: Array) -> int:
    """Number of moves of an input by more than a quarter of its standard deviation: noise about one level is none."""
    if not values.size:
        return 0
    moves, level, least = 0, float(values[0]), 0.25 * float(values.std())
    for value in values.tolist():
        if abs(value - level) > least:
            moves, level = moves + 1, value
    return moves


def _predicts_as_well(candidate: _Candidate, identified: _Candidate) -> bool:
    """True if a reference predicts about as well as the identified models."""
    residuals, others = (item.z * np.array(item.reference.typical_sd) for item in (candidate, identified))
    both = np.isfinite(residuals) & np.isfinite(others)
    for columns in zip(residuals.T, others.T, both.T, strict=True):
        if np.count_nonzero(columns[2]) >= FEWEST_ROWS:
            sds = [learn(np.where(columns[2], column, np.nan), 1e-12).sd for column in columns[:2]]
            # above 1, as the process model holds where the input goes beyond the training
            if sds[0] > 1.5 * sds[1]:
                return False
    return True


def _too_few_values(names: tuple[str, ...], columns: Array, *, by_equations: bool = False) -> dict[str, str]:
    """Signals with too few values, with the reason."""
    return {
        name: f"only {count} of {len(columns)} rows have a value of it, {needed} are needed" if count else NO_VALUE
        for name, count, needed in zip(names, *_counts(columns, by_equations=by_equations), strict=True)
        if count < needed
    }


def _too_few_residuals(
    outputs: tuple[str, ...], z: Array, rows: RowArrays, left_out: dict[str, str], *, by_equations: bool
) -> dict[str, str]:
    """Outputs with values, but too few predictions, with the reason."""
    return {
        name: f"only {count} of its {len(z)} rows could be predicted, {needed} are needed: "
        f"{_prediction_obstacle(rows.time_min, rows.inputs)}"
        for name, count, needed in zip(outputs, *_counts(z, by_equations=by_equations), strict=True)
        if count < needed and name not in left_out
    }


def _counts(columns: Array, *, by_equations: bool) -> tuple[list[int], list[int]]:
    """Numbers of values, and of those that are needed, by the rows from the first value to the last."""
    found = [np.flatnonzero(np.isfinite(column)) for column in columns.T]
    counts = [int(at.size) for at in found]
    spans = [int(at[-1] - at[0]) + 1 if at.size else 0 for at in found]
    needed = [
        needed_values(count, rows, FEWEST_ROWS, by_equations=by_equations)
        for count, rows in zip(counts, spans, strict=True)
    ]
    return counts, needed


def _prediction_obstacle(time_min: Array, inputs: Array) -> str:
    """Reason why rows could not be predicted."""
    follows = regular_intervals(time_min)
    regular = np.count_nonzero(follows)
    if regular < 0.9 * follows.size:
        found = f"{regular} of {follows.size} spacings are within a tenth of the usual"
        return f"do rows come one by one period? {found}; --resample auto, or resample in [monitor], makes them regular"
    known = int(np.count_nonzero(np.isfinite(inputs).all(axis=1)))
    if FEWEST_ROWS <= known < 0.9 * len(inputs):
        return f"{'the input has a value' if inputs.shape[1] == 1 else 'all inputs have values'} in {known} of them"
    return "too often a value is missing in the rows before"


def _refusal(outputs: tuple[str, ...], screenings: list[Screening], evaluated: list[bool]) -> str:
    refused = [
        name
        for name, item, is_evaluated in zip(outputs, screenings, evaluated, strict=True)
        if item.refused and is_evaluated
    ]
    return f"more than a third of it was disturbed in {' and '.join(refused)}" if refused else ""


def _screening_summary(
    outputs: tuple[str, ...], time_min: Array, screenings: list[Screening], evaluated: list[bool]
) -> str:
    """Summary of the rows left out; empty if there are none."""
    lines = []
    for name, item, is_evaluated in zip(outputs, screenings, evaluated, strict=True):
        if not is_evaluated:
            continue
        for (first, last), shift in zip(item.disturbed_intervals, item.shifts, strict=True):
            digits = max(0, 2 - int(log10(max(time_min[-1] - time_min[0], 1.0))))
            since, until = time_min[first] - time_min[0], time_min[last] - time_min[0]
            when = f"{since:.{digits}f} to {until:.{digits}f} min from its start"
            lines.append(f"left out {when}: {name} was off by {shift:+.1f} sd")
        if item.outliers:
            lines.append(f"left out {item.outliers} outliers of {name}")
    return "; ".join(lines)
