"""Diagnosis of a plant's training: deviations from the equations that the plant had from the start. Pure.

A plant whose feed has always been a little warmer than in the simulation is sound. Its training is diagnosed like any
record (`reactorwatch.diagnosis`), and the plant is then judged by the equations with these deviations in them. A
diagnosis takes far longer than a row, so a job and its finding are values, and another process can do the work between
them.

`find_uncertain` finds what a filter should estimate beside the states of the equations:

- Where the rows say that the plant is not quite the equations, or leave open how it follows a move of an input, its
  constants are uncertain (`kalman.filter_states`), and so are predictions until rows have taught them.
- Where the innovations are coloured even so, the plant has disturbances that wander, or its sensors noise with memory.
- Rounding errors of a coarse sensor have memory in any case, or they would pass for movements of the plant.
- White noise left in the balances is taken for inputs that wander, unless the rows speak against it: with these,
  averages of many rows vary most, and a thousand rows hardly tell which it is.

A plant that equals the equations, and that the training has moved enough, needs neither.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from math import nan
from typing import Any, NamedTuple

import msgspec
import numpy as np

from monitor_node.learn.process_reference import first_times, fit_training_noise, model_outputs, output_indices
from monitor_node.learn.training_rows import RowArrays, TrainingRows, screen_baseline
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Baseline
from reactorwatch.description.read import find_process
from reactorwatch.diagnosis.estimates import extended_model
from reactorwatch.diagnosis.whiteness import minus_log10_p
from reactorwatch.errors import InputError
from reactorwatch.kalman.batch import GATE, LONGEST_GAP_MIN, FilterRecord, FilterResult
from reactorwatch.kalman.ekf import Filter, FilterState
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.filter_states import (
    CONSTANT,
    NOISE,
    WANDER,
    is_disturbance,
    learned_parameters,
    select_effects,
    widen_model,
)
from reactorwatch.kalman.noise_estimation import NoiseFit, is_coarse, losses_nearby, resolution_sd
from reactorwatch.process import DEFAULT_PROCESS, effects_of, own_effects
from reactorwatch.process.effect import Effect, ParameterEffect, ParameterShift
from reactorwatch.process.extended_model import parse_extended_model, stored_model
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel
from reactorwatch.process.profiles import FREE_NAME
from reactorwatch.records.record import GAP_ROWS, MINUTE_NS, Record
from reactorwatch.sentences.diagnosis import describe_training

DIAGNOSED = "diagnosed"
"""`Baseline.what` of a change after a diagnosis of the training."""

FAILED = "failed"
"""Verdict of a diagnosis that could not be made."""


class Uncertain(NamedTuple):
    """Additional states of a filter.

    Attributes:
        names: texts of the states, see `kalman.filter_states`.
        learned: values of their `learned_parameters`.
    """

    names: tuple[str, ...] = ()
    learned: tuple[float, ...] = ()

    def add_disturbances(self, model: ProcessModel) -> ProcessModel:
        """Add the disturbances and the coloured noise to a model, not the constants."""
        return widen_model(model, tuple(filter(is_disturbance, self.names)), self.learned)


class DiagnosisJob(NamedTuple):
    """A training to be diagnosed.

    Attributes:
        rows: the rows of the training.
        signals: names of the signals in a row, the input first.
        equations: the model as JSON (`ExtendedModel.to_object`), times in minutes since 1970-01-01 UTC.
        process: name or file of the process, as the monitor was given it.
        causes: names of effects of the process's own, which JSON cannot hold; None: those of the model's name.
        uncertain: standard deviations of parameters of the model, by name.
        effects: these effects; None: they are loaded from the process. They may be a user's code, and are not pickled.
    """

    rows: TrainingRows
    signals: tuple[str, ...]
    equations: str
    process: str | None = None
    causes: tuple[str, ...] | None = None
    uncertain: Mapping[str, float] = {}  # never changed
    effects: tuple[Effect, ...] | None = None

    def __reduce__(self) -> tuple[type["DiagnosisJob"], tuple[Any, ...]]:
        return DiagnosisJob, self[:-1]

    @property
    def first_ns(self) -> int:
        """Time of the first row, which identifies the training."""
        return self.rows.times_ns[0]

    def build_model(self) -> ProcessModel:
        """The model with its effects, times in minutes since the first row.

        Raises:
            InputError: the model, or the file of the process, cannot be read, or the file lacks a cause now.
        """
        model = parse_extended_model(self.equations).shift(-self.first_ns / MINUTE_NS).build()
        if self.causes is None or self.causes == tuple(effect.name for effect in own_effects(model)):
            return model
        if self.effects is not None:
            return replace(model, effects=self.effects)
        found = {effect.name: effect for effect in find_process(self.process or DEFAULT_PROCESS, on_bus=True).causes}
        if missing := [name for name in self.causes if name not in found]:
            raise InputError(
                f"{self.process} must have the causes that it had when the monitor started, lacks {missing[0]}"
            )
        return replace(model, effects=tuple(found[name] for name in self.causes))


class Finding(NamedTuple):
    """Result of a job.

    Attributes:
        first_ns: time of the first row of the training.
        verdict: verdict of the diagnosis, or `FAILED`.
        why: what was found, or why nothing could be, as a sentence without its full stop.
        equations: the extended model as JSON, with its own zero; empty: the equations stay as they are.
    """

    first_ns: int
    verdict: str
    why: str
    equations: str = ""

    @property
    def baseline(self) -> Baseline:
        """The change of the baseline that follows, without its time and number."""
        return Baseline(what=DIAGNOSED, by="monitor", why=self.why, model=self.equations)


def diagnose_training(job: DiagnosisJob) -> Finding:
    """Diagnose a training, and find what a filter should estimate beside the states of the equations.

    Where the rows cannot rank the explanations, the best of them is taken. Of its causes those are taken that last: a
    curve (profile `free`), such as a disturbance, predicts no other rows.

    Raises:
        InputError: the rows cannot be diagnosed: too few, or without movement of the input.
    """
    times_ns, columns = np.array(job.rows.times_ns), np.column_stack(job.rows.arrays[1:]).T
    time_min = _shorten_gaps((times_ns - job.first_ns) / MINUTE_NS)
    record = Record(time_min, dict(zip(job.signals, columns, strict=True)), "training", zero_ns=job.first_ns)
    model = job.build_model()
    outputs = job.signals[len(model.inputs) :]
    rows = RowArrays(time_min, columns[: len(model.inputs)].T, columns[len(model.inputs) :].T)
    uncertain = find_uncertain(model, outputs, rows)
    verdict, why, extended = _diagnose(record, model, uncertain, job.uncertain)
    if extended is not None:
        uncertain = find_uncertain(parse_extended_model(_json(extended)).build(), outputs, rows)
    if uncertain.names:
        why = f"{why}; {describe_uncertain(uncertain.names, model.input_names)}"
    if extended is None and not uncertain.names:
        return Finding(job.first_ns, verdict, why)
    found = parse_extended_model(job.equations).to_object() if extended is None else extended
    return Finding(
        job.first_ns, verdict, why, _json({**found, **({"uncertain": uncertain.names} if uncertain.names else {})})
    )


def _shorten_gaps(time_min: Array) -> Array:
    """Times in which the rows before a long gap come later, so that a jump of the clock does not last for years.

    The filter restarts after the gap in any case, and the rows after the last one keep their times.
    """
    spacings = np.diff(time_min)
    excess = np.maximum(spacings - max(2.0 * LONGEST_GAP_MIN, GAP_ROWS * float(np.median(spacings))), 0.0)
    return np.asarray(time_min + np.append(np.cumsum(excess[::-1])[::-1], 0.0))


def _diagnose(
    record: Record, model: ProcessModel, uncertain: Uncertain, sds: Mapping[str, float]
) -> tuple[str, str, dict[str, Any] | None]:
    """Verdict of the diagnosis, the reason, and the model with the causes that last as JSON; None: there are none.

    Parameters with a standard deviation in `sds` have their adjusted values in it.
    """
    from reactorwatch.diagnosis.diagnose import diagnose  # a quarter of a second, which no other row needs

    try:
        found = diagnose(record, uncertain.add_disturbances(model), uncertain=sds)
    except InputError as error:
        if not uncertain.names:
            raise
        return FAILED, f"not diagnosed: {error}", None
    lasting = [cause for cause in found.causes if cause.profile != FREE_NAME]
    moved = {name: item for name, item in found.parameters.items() if abs(item.value - item.nominal) > 2.0 * item.sd}
    why = "; ".join(
        [describe_training(found), *(f"{name} is {item.value:.4g} {item.unit}" for name, item in moved.items())]
    )
    if not (lasting or moved):
        return found.verdict, why, None
    adjusted = model.with_values({name: item.value for name, item in moved.items()})
    return found.verdict, why, extended_model(adjusted, effects_of(model), lasting, record.zero_ns)


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def equations_text(model: ProcessModel) -> str:
    """JSON of a model as `diagnose` writes it."""
    return _json(stored_model(model).to_object())


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def read_equations(text: str, given: ProcessModel | None = None) -> ProcessModel:
    """The model in `Baseline.model`, its clock that of samples on the bus: minutes since 1970-01-01 UTC.

    It is the same object for the same text and process: what is prepared for one is prepared for all.

    Args:
        text: the JSON.
        given: the model of the process as given, whose own effects it has, too; None: it has those of its name.

    Raises:
        InputError: it is no model of this software.
    """
    try:
        model = parse_extended_model(text).rebase(0).build()
    except InputError as error:
        raise InputError(f"the model of the baseline {error}") from error
    if given is None or own_effects(model) == own_effects(given):
        return model
    return replace(model, effects=own_effects(given))


def _json(extended: dict[str, Any]) -> str:
    return msgspec.json.encode(extended).decode()


LEAST_ROWS = 100
"""Number of values of each output below which nothing is sought."""

LEAST_GAIN = 8.0
"""Gain of log likelihood beyond which something is taken for a part of the plant, or for none of it."""

MOST_DISTURBANCES = 4
"""Number of disturbances from which on no further one is sought: a filter of so many more states would be slow."""

MOST_CONSTANTS = 10
"""Number of constants of the model up to which all may be uncertain: a filter of more states would be slow."""

MOST_FITTED = 2
"""Number of single disturbances that are fitted to find the next: the likeliest with the other noise as it is."""

MOVE_ROWS = 60
"""Number of rows after a move of an input that are predicted."""


def find_uncertain(model: ProcessModel, outputs: tuple[str, ...], rows: RowArrays) -> Uncertain:
    """Find additional states that a filter of the model needs; empty: none."""
    if np.min(np.count_nonzero(np.isfinite(rows.outputs), axis=0), initial=LEAST_ROWS) < LEAST_ROWS:
        return Uncertain()
    fitter = _NoiseFitter(model, outputs, rows)
    coarse = [is_coarse(column) for column in rows.outputs.T]
    rounding = tuple(f"{NOISE} {name}" for name, is_rounded in zip(outputs, coarse, strict=True) if is_rounded)
    plain = fitter.fit(rounding)
    if fitter.drop_disturbances(plain):
        plain = fitter.fit(rounding)
    x = np.nanmedian(fitter.filter(plain).x[:, : len(model.states)], axis=0)
    constants = tuple(f"{CONSTANT} {name}" for name in select_effects(model, x, np.nanmedian(rows.inputs, axis=0)))
    own = tuple(
        f"{CONSTANT} {item.name}" for item in effects_of(model) if isinstance(item, ParameterEffect | ParameterShift)
    )
    own = own if len(own) <= MOST_CONSTANTS else ()
    wide, best = fitter.fit((*constants, *rounding)), plain
    for found in (wide, fitter.fit((*own, *rounding))) if own else (wide,):
        if found.noise.loss < min(best.noise.loss, plain.noise.loss - LEAST_GAIN):
            best = found
    most = len(best.uncertain) + MOST_DISTURBANCES
    inputs = tuple(f"{WANDER} {name}" for name in model.input_names)
    balances = [item.name for item in model.states if item.name not in model.at_rest]
    singles = [*(f"{WANDER} {name}" for name in balances), *inputs, *(f"{NOISE} {name}" for name in outputs)]
    while len(best.uncertain) < most and fitter.are_coloured(best):
        further: list[tuple[str, ...]] = [(item,) for item in singles if item not in best.uncertain]
        further = sorted(further, key=lambda item: fitter.loss_with(best, item))[:MOST_FITTED]
        if not {*inputs} & {*best.uncertain} and len(inputs) > 1:
            further.append(inputs)  # one alone explains little of what several do
        fits = [fitter.fit((*best.uncertain, *item)) for item in further]
        found = min(fits, key=lambda item: item.noise.loss + LEAST_GAIN * len(item.uncertain))
        if found.noise.loss > best.noise.loss - LEAST_GAIN * (len(found.uncertain) - len(best.uncertain)):
            break
        best = found
    open_constants = not any(item.startswith(CONSTANT) for item in best.uncertain)
    if best.moves_balances(len(model.states)):
        # White noise in the balances has no cause; inputs that wander predict more of the same over many rows.
        names = (*(own if open_constants else ()), *best.uncertain, *inputs)
        found = fitter.fit(tuple(dict.fromkeys(names)))
        if found.noise.loss < best.noise.loss + LEAST_GAIN:
            best, open_constants = found, open_constants and not own
    if open_constants:
        wide = fitter.fit(tuple(dict.fromkeys((*constants, *best.uncertain))))
        certain, uncertain = fitter.sds_after_moves(best), fitter.sds_after_moves(wide)
        if np.any(uncertain > 1.25 * certain):  # the training leaves open how the plant follows
            best = wide
    names = best.without_idle
    return Uncertain(names, tuple(best.noise.parameters[name] for name in learned_parameters(model, names)))


def describe_uncertain(uncertain: Sequence[str], inputs: Sequence[str]) -> str:
    """Describe the additional states of a filter in words."""
    parts: dict[str, list[str]] = {CONSTANT: [], WANDER: [], NOISE: []}
    for kind, name in (item.split(" ", 1) for item in uncertain):
        parts[kind].append(name)
    words = [
        f"{name} wanders about its recorded value"
        if name in inputs
        else f"a disturbance of the balance of {name} wanders"
        for name in parts[WANDER]
    ]
    words += [f"the noise of {name} has memory" for name in parts[NOISE]]
    if parts[CONSTANT]:
        words.append("limits allow for what the training leaves open of the constants")
    return ", ".join(words)


class _Fit(NamedTuple):
    """Noise of the model with some uncertain parts, and its filter."""

    uncertain: tuple[str, ...]
    noise: NoiseFit
    filter: Filter

    @property
    def sd_by_state(self) -> dict[str, float]:
        """Process noise by name of the state."""
        return dict(zip(self.filter.model.state_names, self.noise.levels.process_sd, strict=True))

    def moves_balances(self, states: int) -> bool:
        """True if there is noise in the states of the equations, which are the first."""
        return any(self.noise.levels.process_sd[:states])

    @property
    def without_idle(self) -> tuple[str, ...]:
        """The uncertain parts without disturbances that the training does not show."""
        suffix, sds = {WANDER: "wander", NOISE: "memory"}, self.sd_by_state
        pairs = [(item, *item.split(" ", 1)) for item in self.uncertain]
        return tuple(item for item, kind, name in pairs if kind == CONSTANT or sds[f"{name}.{suffix[kind]}"] > 0.0)


class _NoiseFitter:
    """Fits the noise of a model to a training; arguments as for `find_uncertain`."""

    def __init__(self, model: ProcessModel, outputs: tuple[str, ...], rows: RowArrays) -> None:
        self._model, self._outputs, self._rows, self._fits = model, outputs, rows, dict[tuple[str, ...], _Fit]()

    def fit(self, uncertain: tuple[str, ...]) -> _Fit:
        """Fit the noise of the model with uncertain parts; each set of them once."""
        if uncertain not in self._fits:
            self._fits[uncertain] = self._new_fit(uncertain)
        return self._fits[uncertain]

    def _new_fit(self, uncertain: tuple[str, ...]) -> _Fit:
        model, smallest = self._model, [max(resolution_sd(column), 1e-6) for column in self._rows.outputs.T]
        found = fit_training_noise(model, self._outputs, self._rows, smallest, uncertain)
        return _Fit(uncertain, found, Filter(widen_model(model, uncertain), found.levels, found.parameters))

    def loss_with(self, item: _Fit, added: tuple[str, ...]) -> float:
        """Smallest loss with disturbances of several sizes added to a fit, its noise levels as they are."""
        model, levels = widen_model(self._model, (*item.uncertain, *added)), item.noise.levels
        known = item.sd_by_state
        new = np.array([name not in known for name in model.state_names])
        scales = np.array([state.scale for state in model.states])
        before = np.array([known.get(name, 0.0) for name in model.state_names])
        tried = [
            NoiseLevels(levels.measurement_sd, tuple(np.where(new, share * scales, before).tolist()))
            for share in (3.0, 1.0, 0.3, 0.1, 0.03, 0.01)
        ]
        smallest = [1e-9] * len(model.outputs)  # levels that were fitted keep the true bounds
        times = first_times(self._model, self._outputs, (*item.uncertain, *added), self._rows)
        times |= item.noise.parameters
        return min(losses_nearby(model.with_values(times) if times else model, self._record, smallest, tried))

    def drop_disturbances(self, item: _Fit) -> bool:
        """Leave out disturbed intervals and outliers, as a training does; returns true if there are any."""
        run, indices = self.filter(item), output_indices(self._model, self._outputs)
        screenings = [screen_baseline(column) for column in (run.residual / run.sd)[:, indices].T]
        if any(item.refused for item in screenings):
            return False
        usable = np.column_stack([item.usable for item in screenings]) | ~np.isfinite(run.residual[:, indices])
        self._rows, self._fits = self._rows._replace(outputs=np.where(usable, self._rows.outputs, nan)), {}
        return not usable.all()

    def filter(self, item: _Fit) -> FilterResult:
        """Filter the rows; the filter then stands at the last."""
        return item.filter.run(self._record)

    @property
    def _record(self) -> FilterRecord:
        columns = model_outputs(self._model, self._outputs, self._rows.outputs)
        return FilterRecord(self._rows.time_min, self._rows.inputs, columns, GATE)

    def are_coloured(self, item: _Fit) -> bool:
        """True if the innovations are not white."""
        w = np.where(item.noise.w != 0.0, item.noise.w, nan)
        return bool(np.max(minus_log10_p(w, self._rows.inputs[len(self._rows.inputs) - len(w) :])) >= 3.0)

    def sds_after_moves(self, item: _Fit) -> Array:
        """Standard deviations of predictions after a move of each input up and down, shape (moves, rows, n_y)."""
        self.filter(item)
        start, middle = item.filter.state, np.nanmedian(self._rows.inputs, axis=0)
        period_min = float(np.median(np.diff(self._rows.time_min)))
        result = []
        for index, variable in enumerate(self._model.inputs):
            for step in (-variable.scale, variable.scale):
                inputs = middle.copy()
                inputs[index] = min(max(middle[index] + step, variable.lower), variable.upper)
                result.append(_sds_at(item.filter, start, inputs.tolist(), period_min))
        return np.array(result)


def _sds_at(kalman: Filter, start: FilterState, inputs: list[float], period_min: float) -> Array:
    """Standard deviations of the predictions of `MOVE_ROWS` rows with these inputs, shape (rows, n_y)."""
    if start.time_min is None:
        return np.full((MOVE_ROWS, len(kalman.model.outputs)), nan)
    times = [start.time_min + period_min * (row + 1) for row in range(MOVE_ROWS)]
    kalman.state, nothing = start, [nan] * len(kalman.model.outputs)
    expected = [kalman.update(time, inputs, nothing).prediction for time in times]
    kalman.state = start
    return np.array([kalman.update(time, inputs, values).sd for time, values in zip(times, expected, strict=True)])
