"""Diagnosis of a plant's training: deviations from the equations that the plant had from the start. Pure.

A plant whose feed has always been a little warmer than in the simulation is sound. Its training is diagnosed like any
record (`reactorwatch.diagnosis`), and the plant is then judged by the equations with these deviations in them. A
diagnosis takes far longer than a row, so a job and its finding are values, and another process can do the work between
them.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import msgspec
import numpy as np

from monitor_node.baseline.training_rows import TrainingState
from monitor_node.baseline.uncertainty import Uncertain, describe_uncertain, find_uncertain
from reactorwatch.contract.messages_pb2 import Baseline
from reactorwatch.diagnosis.extended import extended_model
from reactorwatch.diagnosis.result import AMBIGUOUS, NOMINAL, Cause, Diagnosis
from reactorwatch.errors import InputError
from reactorwatch.kalman.ekf_step import MODEL_CACHE_SIZE
from reactorwatch.process import EFFECTS_OF, effects_of
from reactorwatch.process.extended_model import ExtendedModel, extended_model_of, is_complete, parse_extended_model
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import FREE_NAME
from reactorwatch.records.record import MINUTE_NS, Record
from reactorwatch.stored_state import unpack_numbers, unpack_times

DIAGNOSED = "diagnosed"
"""`Baseline.what` of a change after a diagnosis of the training."""

FAILED = "failed"
"""Verdict of a diagnosis that could not be made."""


class DiagnosisJob(NamedTuple):
    """A training to be diagnosed.

    Attributes:
        rows: the rows of the training.
        signals: names of the signals in a row, the input first.
        equations: the model as JSON (`ExtendedModel.to_object`), times in minutes since 1970-01-01 UTC.
    """

    rows: TrainingState
    signals: tuple[str, ...]
    equations: str

    @property
    def first_ns(self) -> int:
        """Time of the first row, which identifies the training."""
        return unpack_times(self.rows.times_ns[:8])[0]


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
    times_ns, columns = np.array(unpack_times(job.rows.times_ns)), unpack_numbers(job.rows.rows, len(job.signals)).T
    time_min = (times_ns - job.first_ns) / MINUTE_NS
    record = Record(time_min, dict(zip(job.signals, columns, strict=True)), "training", zero_ns=job.first_ns)
    given = parse_extended_model(job.equations)
    effects = tuple(item.shift(-job.first_ns / MINUTE_NS) for item in given.effects)
    model = replace(given, effects=effects).build()
    outputs = job.signals[len(model.inputs) :]
    measured = columns[len(model.inputs) :].T
    rows = time_min, columns[: len(model.inputs)].T, measured
    uncertain = find_uncertain(model, outputs, *rows)
    verdict, why, extended = _diagnose(record, model, uncertain)
    if extended is not None:
        uncertain = find_uncertain(extended.build(), outputs, *rows)
    if uncertain.names:
        why = f"{why}; {describe_uncertain(uncertain.names)}"
    result = replace(extended or given, uncertain=uncertain.names)
    return Finding(job.first_ns, verdict, why, _json(result.to_object()) if extended or uncertain.names else "")


def _diagnose(record: Record, model: ProcessModel, uncertain: Uncertain) -> tuple[str, str, ExtendedModel | None]:
    """Verdict of the diagnosis, the reason, and the model with the causes that last; None: there are none.

    Args:
        record: the training.
        model: equations of the plant.
        uncertain: what its filter estimates beside the states, see `find_uncertain`.
    """
    from reactorwatch.diagnosis.diagnose import diagnose  # a quarter of a second, which no other row needs

    try:
        found = diagnose(record, uncertain.add_disturbances(model))
    except InputError as error:
        if not uncertain.names:
            raise
        return FAILED, f"not diagnosed: {error}", None
    lasting = [cause for cause in found.causes if cause.profile != FREE_NAME]
    if not lasting:
        return found.verdict, _reason(found), None
    extended = extended_model(model, effects_of(model), lasting, record.zero_ns)
    return found.verdict, _reason(found), parse_extended_model(_json(extended))


def equations_text(model: ProcessModel | None) -> str:
    """JSON of a model as `diagnose` writes it; empty if the catalogue does not have the model, or no causes for it."""
    if model is None or model.name not in EFFECTS_OF:
        return ""
    extended = extended_model_of(model)
    if not is_complete(extended, model):
        return ""
    return msgspec.json.encode(extended.to_object()).decode()


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def read_equations(text: str) -> ProcessModel:
    """The model in `Baseline.model`, its clock that of samples on the bus: minutes since 1970-01-01 UTC.

    It is the same object for the same text: what is prepared for one is prepared for all.

    Raises:
        InputError: it is no model of this software.
    """
    try:
        return parse_extended_model(text).rebase(0).build()
    except InputError as error:
        raise InputError(f"the model of the baseline {error}") from error


def _reason(found: Diagnosis) -> str:
    if found.verdict == NOMINAL:
        return "the training agrees with the equations"
    if not found.causes:
        return f"the training deviates from the equations ({found.location}), and no cause of the catalogue explains it"
    text = f"the training deviates from the equations by {' and '.join(map(_text, found.causes))}"
    others = [" and ".join(map(_text, item.explanation)) for item in found.alternatives]
    return f"{text}; its rows do not rule out {', or '.join(others)}" if found.verdict == AMBIGUOUS else text


def _text(cause: Cause) -> str:
    size = cause.parameters["size"]
    if cause.profile == FREE_NAME:
        return f"{cause.label} ({cause.cause}) in the course of a curve, which predicts no other rows"
    unit = "" if size.unit == "1" else f" {size.unit}"
    return f"{cause.label} ({cause.cause}, {cause.profile}) of {size.value:+.3g}{unit}"


def _json(extended: dict[str, Any]) -> str:
    return msgspec.json.encode(extended).decode()
