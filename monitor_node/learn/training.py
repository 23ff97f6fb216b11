"""Training of a plant's baseline: the reference, the distribution of its residuals, and the rows used.

The rows are kept until the training ends. Then the noise of the process model is estimated from them, or the identified
model is fitted, as the settings ask. Disturbed intervals are left out. The prewhitening is learned from the remaining
residuals. A training with too much disturbance is refused and starts again. After `MOST_REFUSALS` the next is used in
full: a plant that never rests is monitored as well.

A signal with too few values is left out with the reason, and the others are monitored. The identified models predict
without the inputs that are left out.
"""

from collections.abc import Callable
from itertools import compress
from math import log10
from typing import NamedTuple, TypeAlias

import numpy as np
from msgspec.structs import replace

from monitor_node.config import MonitorConfig
from monitor_node.ingest.sampling import regular_intervals
from monitor_node.learn.arx import ROWS_A_PARAMETER, arx_structure, fewest_rows
from monitor_node.learn.arx_reference import ArxReference
from monitor_node.learn.black_box_reference import BlackBoxReference
from monitor_node.learn.process_reference import ProcessReference
from monitor_node.learn.references import Reference
from monitor_node.learn.signal_range import possible_ranges
from monitor_node.learn.training_rows import (
    AfterMoves,
    Mask,
    Screening,
    TrainingRows,
    compare_after_moves,
    screen_baseline,
)
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Check
from reactorwatch.errors import InputError
from reactorwatch.kalman.resolution import resolution_sd
from reactorwatch.process.model import ProcessModel
from reactorwatch.spc.prewhitening import Prewhitening, learn
from reactorwatch.spc.step_test import ROWS as STEP_ROWS

FEWEST_ROWS = 50
"""Least number of residuals; the training continues until there are as many."""

FEWEST_FAMILIAR_ROWS = 200
"""Least number of rows of a training after which `auto` takes a black box: after fewer, too many values of the inputs
are unfamiliar to it, and it judges too few rows."""

MOST_REFUSALS = 2

_Fit: TypeAlias = tuple[Reference, Array, list[float]]
"""A reference, the normalised residuals of the training, and each output's largest deviation of them that does not
matter."""

MINOR = 0.2
"""Share of the smallest relevant standard deviation (of the filter: of the residual's) below which a deviation of a few
times as much does not make an interval disturbed."""

AS_WELL = 1.5
"""Largest ratio of prewhitened residuals, process to identified model, for which `auto` uses the process model. It is
above 1, as the process model holds where the input goes beyond the training."""

USUAL_SHARE = 0.9
"""Least share of rows without a defect; with fewer, the defect is the reason why outputs could not be predicted."""

NO_VALUE = "no value of it has come"
"""Reason for leaving a signal without values out."""

FEWEST_MOVES = 5
"""Moves of an input without which nothing checks how a model without equations follows it."""

NOTHING_LEARNED = Prewhitening(0.0, (), 1.0, FEWEST_ROWS, 0.5 / FEWEST_ROWS, 0.0)
"""Prewhitening of an output that is left out and not evaluated."""


class _Candidate(NamedTuple):
    """A reference, the normalised residuals of the training, shape (n, outputs), and their screening."""

    reference: Reference
    z: Array
    screenings: list[Screening]


class TrainingResult(NamedTuple):
    """Result of a training.

    Attributes:
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
    """

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

    def excess_rate(self, arl0: float) -> float:
        """Times as many false alarms as promised, by what the training shows of moves of the inputs.

        Where it did not determine the dynamics, each new set point may raise every alarm, and the next may come within
        the length of the training.

        Args:
            arl0: in-control run length of each alarm, in rows.
        """
        return max(self.after_moves.excess_rate(arl0), arl0 / len(self.z) if self.weakness else 0.0)


MOST_OUT_OF_RANGE = 1.0 / 3.0
"""Share of impossible values of a signal; with more of them the plant is not the model's process."""


class Training:
    """Learns the baseline of one plant from the rows of its training.

    Args:
        config: settings of the monitor.
        model: process model; None: only the identified models are used.
        models: identified models, which judge after the training if they are chosen.
    """

    def __init__(self, config: MonitorConfig, model: ProcessModel | None, models: ArxReference) -> None:
        self._config, self._model, self._models = config, model, models
        self._without_black_box = self._weakness = ""
        of_one_input = replace(structure := arx_structure(config), inputs=min(structure.inputs, 1))
        of_identified = max(fewest_rows(of_one_input), FEWEST_ROWS)
        self.fewest_rows = FEWEST_ROWS if model is not None else of_identified
        """Least number of values of each output that a training needs."""

    def learn(self, rows: TrainingRows, *, last_chance: bool) -> TrainingResult:
        """Learn from the rows of a training.

        Args:
            rows: the rows.
            last_chance: True to use the training even if it is disturbed.
        """
        time_min, inputs, measured = rows.time_min, rows.inputs, rows.outputs
        outputs = self._config.outputs
        steps = [
            resolution_sd(column, self._config.resolution.get(name))
            for name, column in zip(outputs, measured.T, strict=True)
        ]
        smallest = [
            max(self._config.smallest_sd.get(name, 0.0), sd, 1e-12) for name, sd in zip(outputs, steps, strict=True)
        ]
        left_out = _too_few_values(outputs, measured) | self._constant_outputs(measured, steps)
        measured[:, [name in left_out for name in outputs]] = np.nan
        reference, z, screenings = self._reference(time_min, inputs, measured, smallest, steps)
        if not reference.follows_equations:
            left_out |= _too_few_values(self._config.inputs, inputs)
        left_out |= _too_few_residuals(outputs, z, time_min, inputs, left_out)
        evaluated = [name not in left_out for name in outputs]
        refused = (
            _refusal(outputs, screenings, evaluated) if any(evaluated) else "; ".join(map(": ".join, left_out.items()))
        )
        if refused and last_chance and any(evaluated):
            none = np.zeros(len(z), dtype=np.bool_)
            refused, screenings = "", [Screening(known, [], [], none, none) for known in np.isfinite(z).T]
        usable = np.column_stack([item.usable for item in screenings]) & np.array(evaluated)
        disturbed = np.column_stack([item.left_out for item in screenings]) | ~np.array(evaluated)
        all_z, z = z, np.where(usable, z, np.nan)
        smallest = [sd / typical for sd, typical in zip(smallest, reference.typical_sd, strict=True)]
        learned = [
            learn(column, sd) if is_evaluated else NOTHING_LEARNED
            for column, sd, is_evaluated in zip(z.T, smallest, evaluated, strict=True)
        ]
        e = np.column_stack([_prewhiten(column, item) for column, item in zip(z.T, learned, strict=True)])
        after_moves = AfterMoves()
        if any(evaluated) and not reference.follows_equations:
            columns = [
                np.where(screenings[i].single, np.inf, _prewhiten(all_z[:, i], learned[i]))
                for i in np.flatnonzero(evaluated)
            ]
            after_moves = compare_after_moves(np.column_stack(columns), inputs)
        checks = [
            Check(
                name="training", result=refused or _screening_summary(outputs, time_min, screenings, evaluated) or "ok"
            )
        ]
        if not reference.follows_equations:
            self._weakness = _few_moves(self._config.inputs, inputs) or self._weakness
        if self._weakness:
            checks.append(Check(name=BlackBoxReference.kind, result=self._weakness))
        if self._without_black_box and self._config.reference == "black-box":
            checks.append(Check(name=BlackBoxReference.kind, result=f"the ARX models judge: {self._without_black_box}"))
        if reference.is_identified:
            self._models.start_judging(time_min, np.where(_have_values(inputs), inputs, 0.0), measured)
            checks += [Check(name="model", result=text) for text in self._simplifications(evaluated)]
        checks += [Check(name="signals", result=f"{name} is left out: {why}") for name, why in left_out.items()]
        inputs = np.where([name not in left_out for name in self._config.inputs], inputs, np.nan)
        values = np.hstack([inputs, np.where(disturbed, np.nan, measured)])
        measured = np.where(usable, measured, np.nan)
        responses, outliers = reference.step_responses(STEP_ROWS), [item.outliers for item in screenings]
        return TrainingResult(
            reference,
            learned,
            z,
            e,
            measured,
            values,
            checks,
            refused,
            left_out,
            responses,
            outliers,
            after_moves,
            self._weakness,
        )

    def _simplifications(self, evaluated: list[bool]) -> list[str]:
        """Terms that the identified models lack, each with the outputs."""
        outputs: dict[str, list[str]] = {}
        for name, predictor in compress(zip(self._config.outputs, self._models.predictors, strict=True), evaluated):
            outputs.setdefault(predictor.simplification, []).append(name)
        return [
            f"{', '.join(names)}: predicted with {text}, as there are fewer than {ROWS_A_PARAMETER} rows a parameter"
            for text, names in outputs.items()
            if text
        ]

    def _constant_outputs(self, measured: Array, steps: list[float]) -> dict[str, str]:
        """Outputs that never vary, and have no smallest relevant deviation in the settings, with the reason."""
        return {
            name: f"it reads {np.nanmax(column):.6g} in the whole training; train on rows in which it changes, or "
            "state its smallest_sd or resolution"
            for name, column, step in zip(self._config.outputs, measured.T, steps, strict=True)
            if not step and not self._config.smallest_sd.get(name) and np.isfinite(column).any()
        }

    def _reference(
        self, time_min: Array, inputs: Array, measured: Array, smallest: list[float], steps: list[float]
    ) -> _Candidate:
        """Choose the reference."""
        self._weakness = self._without_black_box = ""
        config = self._config
        minor = [max(MINOR * sd, step) for sd, step in zip(smallest, steps, strict=True)]
        has_values = _have_values(inputs)
        given_inputs = np.where(has_values, inputs, 0.0)
        if not has_values.all():
            self._models.learn_again(time_min, given_inputs, measured)

        def fit_models(rows: Array) -> _Fit:
            return self._models, self._models.fit(time_min, given_inputs, rows), minor

        identified = _refit_without_outliers(fit_models, measured)
        possible = None
        if self._model is not None and has_values.all():
            possible = self._mask_impossible(self._model, inputs, measured)
        if possible is not None:
            model, known_inputs, known_outputs = possible

            def fit_equations(rows: Array) -> _Fit:
                found = ProcessReference.fit(model, config.outputs, time_min, known_inputs, rows, smallest)
                z = found.run(time_min, known_inputs, known_outputs)[1]
                return found, z, _minor(steps, found.typical_sd)

            equations = _refit_without_outliers(fit_equations, known_outputs)
            if config.reference == "equations" or _predicts_as_well(equations, identified):
                return equations
        is_driven = bool(inputs.shape[1] and has_values.all())  # without inputs there is nothing to simulate
        is_long = len(time_min) >= FEWEST_FAMILIAR_ROWS
        if config.reference == "black-box" or (config.reference == "auto" and is_driven and is_long):

            def fit_black_box(rows: Array) -> _Fit:
                found, z = BlackBoxReference.learn(time_min, given_inputs, rows, measured, smallest, config.delay)
                self._weakness = found.weakness  # ARX models know no better how the plant follows the inputs
                return found, z, _minor(steps, found.typical_sd)

            try:
                black_box = _refit_without_outliers(fit_black_box, measured)
            except InputError as error:
                self._weakness, self._without_black_box = "", str(error)
            else:
                if config.reference == "black-box" or (not self._weakness and _predicts_as_well(black_box, identified)):
                    return black_box
        return identified

    def _mask_impossible(
        self, model: ProcessModel, inputs: Array, measured: Array
    ) -> tuple[ProcessModel, Array, Array] | None:
        """Model, inputs and outputs with NaN for impossible values; None if they are too many: another process."""
        columns, ranges = np.column_stack([inputs, measured]), possible_ranges(self._config, model)
        lower, upper = np.array([(item.lower, item.upper) for item in ranges]).T
        out = np.isfinite(columns) & ((columns < lower) | (columns > upper))
        if self._config.reference != "equations" and np.any(np.mean(out, axis=0) > MOST_OUT_OF_RANGE):
            return None
        columns = np.where(out, np.nan, columns)
        return model, columns[:, : inputs.shape[1]], columns[:, inputs.shape[1] :]


def _refit_without_outliers(fit: Callable[[Array], _Fit], measured: Array) -> _Candidate:
    """Fit a reference, screen its residuals, and fit it again without disturbed rows.

    Args:
        fit: fits a reference to outputs.
        measured: outputs, shape (n, outputs).
    """
    reference, z, smallest = fit(measured)
    screenings = [screen_baseline(column, sd) for column, sd in zip(z.T, smallest, strict=True)]
    is_clean = not any(item.disturbed_intervals or item.outliers for item in screenings)
    if not is_clean and not any(item.refused for item in screenings):
        kept = np.column_stack([item.usable for item in screenings]) | ~np.isfinite(z)
        reference, z, _ = fit(np.where(kept, measured, np.nan))
    return _Candidate(reference, z, screenings)


def _minor(steps: list[float], sds: list[float]) -> list[float]:
    """Largest normalised deviation of each output that does not matter."""
    return [max(MINOR, step / sd) for step, sd in zip(steps, sds, strict=True)]


def _prewhiten(z: Array, learned: Prewhitening) -> Array:
    e = z - learned.constant
    for lag, coefficient in enumerate(learned.coefficients, start=1):
        e[lag:] -= coefficient * z[:-lag]
        e[:lag] = np.nan
    return np.asarray(e / learned.sd)


def _few_moves(names: tuple[str, ...], inputs: Array) -> str:
    """Reason why the training cannot show how the outputs follow an input that hardly ever moved; empty if it can."""
    counts = np.count_nonzero(np.nan_to_num(np.diff(inputs, axis=0)), axis=0).tolist()
    few = [
        f"{name} ({count}; {FEWEST_MOVES} are needed)"
        for name, count in zip(names, counts, strict=True)
        if 0 < count < FEWEST_MOVES
    ]
    if not few:
        return ""
    return (
        f"the training has too few moves of {', '.join(few)}: at other set points false alarms may be more than "
        "promised; train over more set points"
    )


def _predicts_as_well(candidate: _Candidate, identified: _Candidate) -> bool:
    """True if a reference predicts about as well as the identified models."""
    residuals, others = (item.z * np.array(item.reference.typical_sd) for item in (candidate, identified))
    both = np.isfinite(residuals) & np.isfinite(others)
    for columns in zip(residuals.T, others.T, both.T, strict=True):
        if np.count_nonzero(columns[2]) >= FEWEST_ROWS:
            sds = [learn(np.where(columns[2], column, np.nan), 1e-12).sd for column in columns[:2]]
            if sds[0] > AS_WELL * sds[1]:
                return False
    return True


def _have_values(columns: Array) -> Mask:
    """Flags of the columns with values enough."""
    return np.asarray(np.count_nonzero(np.isfinite(columns), axis=0) >= FEWEST_ROWS)


def _too_few_values(names: tuple[str, ...], columns: Array) -> dict[str, str]:
    """Signals with too few values, with the reason."""
    counts = np.count_nonzero(np.isfinite(columns), axis=0).tolist()
    return {
        name: NO_VALUE
        if not count
        else f"only {count} of {len(columns)} rows have a value of it, {FEWEST_ROWS} are needed"
        for name, count in zip(names, counts, strict=True)
        if count < FEWEST_ROWS
    }


def _too_few_residuals(
    outputs: tuple[str, ...], z: Array, time_min: Array, inputs: Array, left_out: dict[str, str]
) -> dict[str, str]:
    """Outputs with values, but too few predictions, with the reason."""
    counts = np.count_nonzero(np.isfinite(z), axis=0).tolist()
    return {
        name: f"only {count} of its {len(z)} rows could be predicted, {FEWEST_ROWS} are needed: "
        f"{_prediction_obstacle(time_min, inputs)}"
        for name, count in zip(outputs, counts, strict=True)
        if count < FEWEST_ROWS and name not in left_out
    }


def _prediction_obstacle(time_min: Array, inputs: Array) -> str:
    """Reason why rows could not be predicted."""
    follows = regular_intervals(time_min)
    regular = np.count_nonzero(follows)
    if regular < USUAL_SHARE * follows.size:
        return f"do rows come one by one period? {regular} of {follows.size} spacings are within a tenth of the usual"
    known = int(np.count_nonzero(np.isfinite(inputs).all(axis=1)))
    if FEWEST_ROWS <= known < USUAL_SHARE * len(inputs):
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
