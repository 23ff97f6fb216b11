"""Any catalogue will do for a diagnosis: none, one effect, or only such as have memory."""

import json
from collections.abc import Sequence

import numpy as np
import pytest

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.report.page import as_page
from reactorwatch.diagnosis.result import AMBIGUOUS, NAMED, NOMINAL, UNKNOWN
from reactorwatch.process import effects_of
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.records.record import Record
from reactorwatch.sentences.diagnosis import diagnosis_text
from tests.unit.diagnosis.linear_tank import NOISE_SD, PERIOD_MIN, Shift, follows, tank
from tests.unit.diagnosis.runs import record_of

LEVELS = np.repeat([4.0, 7.0, 3.0, 6.0, 2.0, 8.0, 5.0, 4.0, 6.0, 3.0], 60)


def tank_record(gain: float) -> Record:
    """Level of a tank whose input has another gain."""
    level = follows(gain * LEVELS, gain * LEVELS[0])
    noise = NOISE_SD * np.random.default_rng(1).standard_normal(level.size)
    return Record(PERIOD_MIN * np.arange(level.size, dtype=np.float64), {"u": LEVELS, "h": level + noise}, "tank")


def select(*names: str) -> tuple[Effect, ...]:
    """Effects of the reactor with these names."""
    return tuple(effect for effect in EFFECTS if effect.name in names)


@pytest.mark.parametrize(
    ("effects", "gain", "verdict"),
    [
        (None, 1.0, NOMINAL),
        (
            None,
            1.2,
            AMBIGUOUS,
        ),  # the gain of the input is one over the outflow's and the area's: two more causes do that
        ((), 1.0, NOMINAL),
        ((), 1.2, UNKNOWN),
        ((Shift(),), 1.0, NOMINAL),
        ((Shift(),), 1.2, UNKNOWN),  # a free shift does what another gain does, but a law with one parameter does, too
    ],
)
def test_a_model_of_ones_own_is_diagnosed_with_whatever_catalogue(
    effects: Sequence[Effect] | None, gain: float, verdict: str
) -> None:
    model = tank()
    found = diagnose(tank_record(gain), model, effects)
    named = effects_of(model) if effects is None else effects
    assert (found.verdict, bool(found.causes)) == (verdict, verdict in (NAMED, AMBIGUOUS))
    assert found.significant == found.practical == (verdict != NOMINAL)
    assert json.loads(json.dumps(found.to_dict()))["verdict"] == verdict
    assert diagnosis_text(found, named).startswith(found.file)
    assert as_page(found, model, named, "a.csv", "m.json", "x.csv", on_the_bus=False).startswith("<!doctype html>")


@pytest.mark.parametrize(
    "names",
    [
        ("valve_stiction",),
        *(
            pytest.param(names, marks=pytest.mark.slow)
            for names in ((), ("jacket_lag", "temperature_lag"), ("concentration_delay",))
        ),
    ],
)
def test_what_a_small_catalogue_does_not_explain_is_unknown(names: tuple[str, ...]) -> None:
    record = record_of("coolant_flow:step:-0.05@30min", "temperature_bias:step:2@20min", rows=450)
    found = diagnose(record, cstr(), select(*names))
    assert (found.verdict, found.causes) == (UNKNOWN, ())
    assert found.location
