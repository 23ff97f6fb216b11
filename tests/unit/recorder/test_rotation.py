"""The times at which a recording is flushed, synced and followed by a new file."""

from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from recorder.keep import SECOND_NS, FlushAndRotation, Fsync

HALF = SECOND_NS // 2
START = 1_000 * SECOND_NS


def filing(fsync: Fsync = "never", rotate_s: float = inf, rotate_bytes: float = inf) -> FlushAndRotation:
    return FlushAndRotation(HALF, fsync, rotate_s * SECOND_NS, rotate_bytes, START)


@given(gaps=st.lists(st.integers(0, 2 * SECOND_NS), max_size=60))
def test_no_message_waits_longer_than_the_period_for_its_flush(gaps: list[int]) -> None:
    """Driven as the loop drives it: at each message, and at the moment that was named as the next."""
    decide, now = filing(), START
    waiting: list[int] = []

    def look(now: int) -> None:
        if decide.flush_is_due(now):
            assert all(now - since <= HALF for since in waiting)
            waiting.clear()
            decide.mark_flushed()

    for gap in gaps:
        while (due := decide.next_due_ns()) <= now + gap:
            look(due)
        now += gap
        decide.count_message(now)
        waiting.append(now)
        look(now)
    assert all(now - since < HALF for since in waiting)
    assert decide.unflushed == len(waiting)


def test_without_messages_nothing_is_due() -> None:
    decide = filing("second", rotate_s=1)
    assert not decide.flush_is_due(START + 100 * SECOND_NS)
    assert not decide.is_full(START + 100 * SECOND_NS, 10**9)
    assert decide.next_due_ns() > START + 10**6 * SECOND_NS


@pytest.mark.parametrize(("fsync", "synced"), [("never", 0), ("chunk", 20), ("second", 10)])
def test_the_policy_sets_how_often_ten_seconds_are_synced(fsync: Fsync, synced: int) -> None:
    """A message each tenth of a second, a flush each half, from START on."""
    decide, syncs = filing(fsync), 0
    for tenth in range(101):
        now = START + tenth * SECOND_NS // 10
        if decide.flush_is_due(now):
            decide.mark_flushed()
        if decide.sync_is_due(now):
            syncs += 1
            decide.mark_synced(now)
        if tenth % 5 == 0:
            decide.count_message(now)
    assert syncs == synced


def test_a_file_is_full_by_age_or_by_size() -> None:
    decide = filing(rotate_s=60, rotate_bytes=1000)
    decide.count_message(START)
    assert not decide.is_full(START + 59 * SECOND_NS, 999)
    assert decide.is_full(START + 59 * SECOND_NS, 1000)
    assert decide.is_full(START + 60 * SECOND_NS, 0)
    decide.start_file(START + 60 * SECOND_NS)
    decide.count_message(START + 60 * SECOND_NS)
    assert not decide.is_full(START + 119 * SECOND_NS, 0)


def test_a_clock_that_is_set_back_puts_nothing_off() -> None:
    decide = filing(rotate_s=60)
    decide.count_message(START)
    hour_ago = START - 3600 * SECOND_NS
    assert not decide.flush_is_due(hour_ago)
    assert decide.flush_is_due(hour_ago + HALF)
    assert decide.is_full(hour_ago + 60 * SECOND_NS, 0)


def test_a_sync_is_due_a_second_after_the_last_one_when_the_clock_is_set_back_before_it() -> None:
    decide = filing("second")
    decide.count_message(START)
    decide.mark_flushed()
    hour_ago = START - 3600 * SECOND_NS
    assert not decide.sync_is_due(hour_ago)
    assert decide.next_due_ns() == hour_ago + SECOND_NS
    assert decide.sync_is_due(hour_ago + SECOND_NS)
