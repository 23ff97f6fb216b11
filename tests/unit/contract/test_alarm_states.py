"""The life of an alarm is that of ISA-18.2 and IEC 62682: every state, every event, any order of them."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reactorwatch.contract.alarm_states import (
    CODES,
    OUT_OF_SIGHT,
    TABLE,
    ByCondition,
    Event,
    Refused,
    State,
    diagram,
    is_consistent,
    next_state,
)
from reactorwatch.contract.messages_pb2 import AlarmState
from reactorwatch.errors import InputError

DOCUMENT = Path(__file__).parents[3] / "docs" / "alarms.md"

LETTERS = dict(zip("ABCDGHI", State, strict=True))
"""The standard's letters; G, H and I are its shelved, suppressed by design and out of service."""

# Rows are states; an entry is the next state, '?' B if the condition stands and A if not, '.' refused.
STANDARD = """
    raised cleared acknowledge shelve unshelve shelf-time-over suppress unsuppress take-out return
A   B      .       .           G      .        .               H        .          I        .
B   .      D       C           G      .        .               H        .          I        .
C   .      A       .           G      .        .               H        .          I        .
D   B      .       A           G      .        .               H        .          I        .
G   G      G       .           G      ?        ?               .        .          I        .
H   H      H       .           .      .        .               .        ?          I        .
I   I      I       .           .      .        .               .        .          .        ?
"""
ENTRIES = [
    (LETTERS[line.split()[0]], event, entry)
    for line in STANDARD.strip().splitlines()[1:]
    for event, entry in zip(Event, line.split()[1:], strict=True)
]


@pytest.mark.parametrize(("state", "event", "entry"), ENTRIES, ids=[f"{s}: {e}" for s, e, _ in ENTRIES])
@pytest.mark.parametrize("standing", [True, False])
def test_every_pair_of_state_and_event_is_that_of_the_standard(
    state: State, event: Event, entry: str, standing: bool
) -> None:
    if entry == ".":
        with pytest.raises(InputError, match=r"^(is|stands|does not stand)"):
            next_state(state, event, active=standing)
        return
    letter = ("B" if standing else "A") if entry == "?" else entry
    assert next_state(state, event, active=standing) is LETTERS[letter]


def test_the_table_has_every_pair_and_no_other() -> None:
    assert set(TABLE) == set(State)
    assert all(set(row) == set(Event) for row in TABLE.values())
    assert len(ENTRIES) == len(State) * len(Event)


def test_every_state_has_its_value_on_the_bus() -> None:
    assert {AlarmState.Name(CODES[state]) for state in State} == {f"ALARM_STATE_{state.name}" for state in State}


@given(st.lists(st.sampled_from(Event), max_size=60))
@settings(max_examples=300)
def test_no_sequence_of_events_leaves_the_table_or_loses_the_condition(events: list[Event]) -> None:
    state, standing = State.NORMAL, False
    for event in events:
        after = {Event.RAISED: True, Event.CLEARED: False}.get(event, standing)
        if after == standing and event in (Event.RAISED, Event.CLEARED):
            continue  # samples raise what does not stand, and clear what does; nothing else
        before, outcome = state, TABLE[state][event]
        if isinstance(outcome, Refused):
            assert event not in (Event.RAISED, Event.CLEARED), "samples are never refused"
            continue
        standing = after
        state = next_state(state, event, active=standing)
        assert is_consistent(state, active=standing)
        if before in OUT_OF_SIGHT and state not in OUT_OF_SIGHT:
            assert state is (State.UNACKNOWLEDGED if standing else State.NORMAL)


def test_the_diagram_of_the_docs_is_drawn_from_the_table() -> None:
    assert f"```mermaid\n{diagram()}\n```" in DOCUMENT.read_text(encoding="utf-8"), (
        "docs/alarms.md: put what alarm_states.diagram() returns between the lines of its mermaid block"
    )


def test_the_diagram_has_an_arrow_for_every_entry_that_is_not_refused() -> None:
    drawn = {tuple(line.split(": ", 1)) for line in diagram().splitlines() if ": " in line}
    arrows = {places.strip(): texts.split(" / ") for places, texts in drawn}
    count = 0
    for state, row in TABLE.items():
        for event, outcome in row.items():
            if isinstance(outcome, ByCondition):
                assert f"{event}, stands" in arrows[f"{state.name} --> {outcome.active.name}"]
                assert f"{event}, over" in arrows[f"{state.name} --> {outcome.normal.name}"]
                count += 2
            elif isinstance(outcome, State):
                assert event in arrows[f"{state.name} --> {outcome.name}"]
                count += 1
    assert sum(len(texts) for texts in arrows.values()) == count
