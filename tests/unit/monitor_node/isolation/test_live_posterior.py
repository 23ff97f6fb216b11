"""After an alarm the probabilities of the causes follow each row, in a single monitor and in a fleet."""

from dataclasses import replace
from math import nan

import numpy as np
import pytest

from monitor_node.isolation.causes import causes_of
from monitor_node.isolation.isolation import Isolation
from monitor_node.isolation.live_posterior import LivePosterior
from monitor_node.isolation.residual import log_evidence_of_sums
from monitor_node.isolation.suspect import UNKNOWN, Suspect
from monitor_node.isolation.window import Row
from reactorwatch.kalman.ekf import Filter
from reactorwatch.process.library.cstr.model import cstr

from ..faulty import ONSET_MIN, SENSORS, rows_of

ALARM, LOOK, ROWS = 602, 30, 120
"""Index of the first row with an alarm; rows since then at the look, and rows after it."""

FAULTS = {
    "coolant_flow:step:-0.03": -0.03,
    "feed_temperature:step:3": 3.0,
    "feed_concentration:ramp:0.2@60.03min,end=90min": 0.2,
    "temperature_bias:step:2": 2.0,
}


def after_look(rows: list[Row], excluded: tuple[str, ...] = ()) -> LivePosterior:
    chosen = tuple(effect for effect in causes_of(cstr()) if effect.name not in excluded)
    isolation = Isolation(replace(cstr(), effects=chosen), SENSORS)
    isolation.suspects(rows[: ALARM + LOOK], LOOK)
    live = isolation.follow()
    assert live is not None
    return live


def follow(live: LivePosterior, rows: list[Row]) -> list[list[Suspect]]:
    """Suspects after each row."""
    result = []
    for time_min, inputs, measured in rows:
        assert live.update(time_min, inputs, measured)
        result.append(live.suspects())
    return result


def faulty(fault: str, seed: int = 3) -> list[Row]:
    return rows_of(fault, seed=seed, after_min=0.1 * (LOOK + ROWS) + 1.0)


@pytest.fixture(scope="module")
def leak() -> list[Row]:
    return faulty("coolant_flow:step:-0.04")


def test_the_first_suspects_are_those_of_the_look_and_the_truth_gains_with_the_rows(leak: list[Row]) -> None:
    isolation = Isolation(cstr(), SENSORS)
    at_look = isolation.suspects(leak[: ALARM + LOOK], LOOK)
    live = isolation.follow()
    assert live is not None
    start = {item.cause: item for item in live.suspects()}
    for item in (item for item in at_look if item.probability > 1e-4):
        assert start[item.cause].probability == pytest.approx(item.probability, abs=2e-3)
        assert start[item.cause].size == pytest.approx(item.size, nan_ok=True)
    known = follow(live, leak[ALARM + LOOK : ALARM + LOOK + ROWS])[-1][0]
    assert known.cause == "coolant_flow"
    assert known.probability > 0.8 > start["coolant_flow"].probability


@pytest.mark.parametrize("fault", FAULTS)
def test_each_row_refines_the_size_towards_the_truth(fault: str) -> None:
    """The standard deviation shrinks, and the truth stays within four of them."""
    rows = faulty(fault)
    live = after_look(rows)
    cause, kind = fault.split(":")[:2]
    sizes = [
        item for each in follow(live, rows[ALARM + LOOK : ALARM + LOOK + ROWS]) for item in each if item.cause == cause
    ]
    last_min = rows[ALARM + LOOK + ROWS - 1][0]
    size = FAULTS[fault]
    if kind == "ramp":  # the size is that in the last row
        size *= (last_min - ONSET_MIN) / (90.0 - ONSET_MIN)
    assert sizes[-1].size_sd < sizes[0].size_sd
    assert sizes[-1].size == pytest.approx(size, abs=4.0 * sizes[-1].size_sd + 0.05 * abs(size))


def test_a_bank_of_a_sound_plant_is_its_filter(leak: list[Row]) -> None:
    """The filter without a fault in the bank agrees with the filter of the model, also over lost rows."""
    live = after_look(leak)
    model, noise = cstr(), SENSORS
    own = Filter(model, noise)
    for time_min, inputs, measured in leak[: ALARM + LOOK]:
        own.update(time_min, inputs, measured)
    for row in (*range(ALARM + LOOK, ALARM + LOOK + 40), ALARM + LOOK + 42, ALARM + LOOK + 43):
        time_min, inputs, measured = leak[row]
        lost = row == ALARM + LOOK + 42 and inputs != leak[row - 3][1]
        between = np.linspace(leak[row - 3][0], time_min, 4)[1:].tolist()
        own.update(time_min, inputs, measured, changes=[(time, inputs) for time in between] if lost else [])
        assert live.update(time_min, inputs, measured)
    x = live._filters["belief"][-1][: len(model.states)]
    assert x == pytest.approx(own.state.x, rel=1e-6)


def test_a_cause_that_is_not_among_the_filters_makes_the_unknown_more_likely() -> None:
    rows = faulty("temperature_bias:ramp:8@60.03min,end=90min")
    excluded = ("temperature_bias",)
    live = after_look(rows, excluded)
    last = follow(live, rows[ALARM + LOOK : ALARM + LOOK + ROWS])[-1]
    assert last[0].cause == UNKNOWN
    assert last[0].probability > 0.9


def test_a_single_outlier_or_a_missing_value_changes_no_probability_much(leak: list[Row]) -> None:
    live, same = after_look(leak), after_look(leak)
    part = leak[ALARM + LOOK : ALARM + LOOK + 40]
    time_min, inputs, (_, temperature) = part[20]
    expected = {item.cause: item.probability for item in follow(same, part)[-1]}
    for value in (nan, 5.0):
        bad = [*part[:20], (time_min, inputs, (value, temperature)), *part[21:]]
        live = after_look(leak)
        for item in follow(live, bad)[-1]:
            assert item.probability == pytest.approx(expected[item.cause], abs=0.05)


def test_a_first_far_value_has_the_effect_of_a_missing_one_and_a_second_one_counts(leak: list[Row]) -> None:
    (time_min, inputs, (concentration, temperature)), (next_min, *_) = leak[ALARM + LOOK : ALARM + LOOK + 2]
    missing, far = after_look(leak), after_look(leak)
    assert missing.update(time_min, inputs, (nan, temperature))
    assert far.update(time_min, inputs, (50.0 * concentration, temperature))
    assert far.state.filters == missing.state.filters
    assert far.update(next_min, inputs, (50.0 * concentration, temperature))
    assert missing.update(next_min, inputs, (nan, temperature))
    assert far.state.filters != missing.state.filters


def test_probabilities_have_moved_if_they_differ_by_the_least_from_those_published(leak: list[Row]) -> None:
    live = after_look(leak)
    live.note_published()
    before = live._published
    assert not live.has_moved(1e-12)
    follow(live, leak[ALARM + LOOK : ALARM + LOOK + 20])
    evidence = live._filters["log_evidence"]
    best = int(np.argmax(evidence[:-1]))
    weights = np.append(evidence, evidence[best] + log_evidence_of_sums(live._filters[best]))
    shares = np.exp(weights - np.max(weights))
    moved = float(np.sum(np.abs(shares / np.sum(shares) - before)))
    assert moved > 1e-6
    assert live.has_moved(moved * (1 - 1e-9))
    assert not live.has_moved(moved * (1 + 1e-9))


def test_a_restored_posterior_goes_on_bit_for_bit_and_one_of_other_causes_is_refused(leak: list[Row]) -> None:
    live = after_look(leak)
    follow(live, leak[ALARM + LOOK : ALARM + LOOK + 20])
    other = LivePosterior(cstr(), SENSORS, causes_of(cstr()))
    assert other.restore(type(live.state).from_bytes(live.state.to_bytes()))
    rest = leak[ALARM + LOOK + 20 : ALARM + LOOK + 50]
    assert follow(other, rest) == follow(live, rest)
    assert other.state == live.state
    assert not LivePosterior(cstr(), SENSORS, causes_of(cstr())[1:]).restore(live.state)


def test_a_gap_ends_it(leak: list[Row]) -> None:
    live = after_look(leak)
    _, inputs, measured = leak[ALARM + LOOK]
    assert not live.update(leak[ALARM + LOOK - 1][0] + 0.6, inputs, measured)
