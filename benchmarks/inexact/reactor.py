"""The reactor that is not quite the model: the class of the study of the diagnosis, with its hidden causes."""

from benchmarks.diagnosis_study import FIRST_SEED
from benchmarks.hidden.classes import NEARLY, draw_record, find_class
from benchmarks.inexact.records import Cause, Drawn
from tests.hidden_effect.draw import draw as draw_hidden


def draw(seed: int, number: int, sound: bool) -> Drawn:
    """Draw a record; those of seed 1 are the ones of the study."""
    study, first_seed = find_class(NEARLY), seed * FIRST_SEED
    if sound:
        hidden = draw_hidden(first_seed - 1 - number, (), study.circumstances(number))
    else:
        hidden = draw_record(study, number, first_seed)
    cause = None
    for effect, course in zip(hidden.effects, hidden.courses, strict=True):
        onset_min = course.onset_min if course.kind == "step" else None
        cause = Cause((effect.name,), (course.size,), "that of the catalogue", onset_min, course.kind)
    columns = {"time_min": hidden.record.time_min} | {name: hidden.record.columns[name] for name in ("qc", "C", "T")}
    period_min = float(hidden.record.time_min[1] - hidden.record.time_min[0])
    return Drawn("reactor", NEARLY, seed, number, "cstr", columns, period_min, cause, {"drawn from": hidden.seed})
