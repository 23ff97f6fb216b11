"""A record's alarms do not depend on where its time begins."""

from collections.abc import Iterator

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import Aligner
from monitor_node.replay.backtest import run
from reactorwatch.contract.codec import encode
from reactorwatch.records.record import MINUTE_NS, Record
from reactorwatch.results.backtest import Backtest
from recorder.tools.player import samples_of

from .samples import leaking_run

CONFIG = MonitorConfig(training_min=20.0, isolation=False, diagnose_training=False)
ONSET_MIN = 35.0


@pytest.fixture(scope="module")
def leaking() -> Record:
    time_min, columns = leaking_run(-0.15, ONSET_MIN, 50.0, 3)
    return Record(time_min, columns, "run.csv")


@pytest.fixture(scope="module")
def expected(leaking: Record) -> list[tuple[str, int, int | None]]:
    found = raised(watched(leaking, 0), 0)
    assert len(found) >= 4
    return found


def watched(record: Record, zero_ns: int) -> Backtest:
    return run((encode(item) for item in samples_of(record, "cstr", zero_ns)), CONFIG)


def raised(result: Backtest, zero_ns: int) -> list[tuple[str, int, int | None]]:
    """Alarms with the nanoseconds since the beginning at which they were raised and cleared."""
    return [
        (alarm.alarm, alarm.raised_ns - zero_ns, None if cleared_ns is None else cleared_ns - zero_ns)
        for alarm, cleared_ns in result.raised_alarms
    ]


@given(st.integers(-(2**61), 2**61))
@example(-round(ONSET_MIN * MINUTE_NS))
@example(-round(50 * MINUTE_NS))
@example(-round(60 * MINUTE_NS))
@example(-1)
@settings(max_examples=6, deadline=None)
def test_alarms_are_the_same_wherever_time_begins(
    leaking: Record, expected: list[tuple[str, int, int | None]], zero_ns: int
) -> None:
    """Before 1970, across it, and after it."""
    result = watched(leaking, zero_ns)
    assert raised(result, zero_ns) == expected
    assert result.runs == 1


def test_an_alarm_that_is_raised_at_time_zero_is_raised(
    leaking: Record, expected: list[tuple[str, int, int | None]]
) -> None:
    for _, raised_ns, _ in expected[:2]:
        assert raised(watched(leaking, -raised_ns), -raised_ns) == expected


@given(st.integers(-(2**61), 2**61))
def test_rows_are_lined_up_alike_wherever_time_begins(zero_ns: int) -> None:
    """A lost sample, one that comes late and a clock that is set back, before and after zero."""

    def samples() -> Iterator[tuple[str, int, int]]:
        for row in range(40):
            for signal in ("qc", "T"):
                if (row, signal) not in ((5, "T"), (9, "qc")):
                    yield signal, row, row * 6 - (100 if row >= 25 else 0)
                if (row, signal) == (10, "T"):
                    yield "qc", 9, 54

    def rows(origin_ns: int) -> tuple[list[tuple[int, bool]], object]:
        aligner = Aligner(("qc", "T"), 5)
        found = [
            (row.time_ns - origin_ns, row.restarted)
            for signal, number, time_ns in samples()
            for row in aligner.update(signal, origin_ns + time_ns, number, 1.0)
        ]
        return found, aligner.memory.counts

    assert rows(zero_ns) == rows(0)
