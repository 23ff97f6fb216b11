"""Rows of one period on the bus: those of the resampled record, with their inputs held, gaps left and runs apart."""

import numpy as np
import pytest
from numpy.typing import NDArray

from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import Row
from monitor_node.ingest.resampler import Resampler, ResamplerMemory
from reactorwatch.records.file_format import parse_resampling
from reactorwatch.records.record import Record
from reactorwatch.records.resampling import resample

S = 1_000_000_000
NAMES = ("u", "T", "C")
EXAMPLE = "10 s"

Array = NDArray[np.float64]


def bus_rows() -> list[Row]:
    """Rows of a bus, each with what has its time: u when it moves, T each 3 s with jitter, C each 100 s."""
    rng = np.random.default_rng(1)
    values: dict[int, list[float]] = {}
    times = {
        0: np.cumsum(rng.exponential(90.0, 60)),
        1: np.arange(0.0, 5000.0, 3.0) + rng.uniform(0.0, 1.0, 1667),
        2: np.arange(7.0, 5000.0, 100.0),
    }
    for index, seconds in times.items():
        for at in (seconds * S).astype(np.int64).tolist():
            values.setdefault(at, [np.nan] * 3)[index] = float(rng.normal())
    first = values.setdefault(0, [np.nan] * 3)
    first[:] = [1.0, 2.0, np.nan]
    return [Row(at, tuple(values[at]), at == 0) for at in sorted(values)]


def resampler(rule: str = EXAMPLE) -> Resampler:
    return Resampler(parse_resampling(rule, "resample"), NAMES[:1], NAMES[1:])


def make(rows: list[Row], of: Resampler) -> list[Row]:
    made = [row for item in rows for row in of.update(item)]
    return [*made, *of.flush()]


def same(first: list[Row], second: list[Row]) -> bool:
    return repr(first) == repr(second)  # NaN is not equal to itself


@pytest.mark.parametrize("rule", [EXAMPLE, "10 s,last", "7 s,C=last", "10 s,T=sparse", "10 s,T=interpolated"])
def test_the_rows_are_those_of_the_resampled_record(rule: str) -> None:
    """But for the last ones."""
    rows = bus_rows()
    columns = {name: np.array([row.values[index] for row in rows]) for index, name in enumerate(NAMES)}
    record = Record(np.array([row.time_ns for row in rows]) / (60 * S), columns, "bus")
    expected = resample(record, parse_resampling(rule, "resample"), {"u": "input"})
    made = make(rows, resampler(rule))
    np.testing.assert_allclose([row.time_ns / (60 * S) for row in made[:450]], expected.time_min[:450])
    for index, name in enumerate(NAMES):
        found = [row.values[index] for row in made[:450]]
        np.testing.assert_allclose(found, expected.columns[name][:450], atol=1e-9, err_msg=name)


def test_a_stored_memory_resumes_with_the_same_rows_bit_for_bit() -> None:
    rows, whole, stopped = bus_rows(), resampler(), resampler()
    expected, found = [], []
    for number, row in enumerate(rows):
        expected += whole.update(row)
        if number % 7 == 0:
            stored, stopped = stopped.memory.to_bytes(), resampler()
            stopped.memory = ResamplerMemory.from_bytes(stored)
        found += stopped.update(row)
    assert same(expected, found)


def test_a_gap_of_more_than_five_periods_stays_one_and_a_restart_starts_a_run() -> None:
    rows = [Row(at * S, (1.0 if at == 0 else np.nan, float(at), np.nan), at == 0) for at in range(0, 100, 2)]
    later = [
        row._replace(time_ns=row.time_ns + 1000 * S, values=(np.nan, 5.0, np.nan), restarted=False) for row in rows
    ]
    made = make([*rows, *later], resampler())
    steps = np.diff([row.time_ns // S for row in made])
    assert sorted(steps)[-2:] == [10, 910]
    assert {row.values[0] for row in made} == {1.0}  # what was not sent has not moved
    assert [row.restarted for row in made] == [True] + [False] * (len(made) - 1)
    again = make([*rows, *rows], resampler())
    assert [row.time_ns for row in again] == [row.time_ns for row in make(rows, resampler())] * 2


@pytest.mark.parametrize(
    ("rule", "error"),
    [
        ("auto", "resample must state a period, such as 10 s, got 'auto'"),
        ("10 s,Z=last", "resample has methods of inputs and outputs, .*, got 'Z'"),
    ],
)
def test_a_setting_that_no_bus_can_keep_is_refused(rule: str, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        MonitorConfig(resample=rule)


@pytest.mark.parametrize("method", ["mean", "interpolated"])
def test_a_slow_output_whose_next_value_is_needed_is_held(method: str) -> None:
    rows = bus_rows()
    found, last = (make(rows, resampler(f"10 s,C={name}")) for name in (method, "last"))
    assert same(found[40:], last[40:])
