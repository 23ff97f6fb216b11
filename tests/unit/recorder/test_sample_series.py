"""Samples of one plant as columns: by run and signal, with the values that count as measured."""

import math
from typing import Any

import pytest

from reactorwatch.contract import messages_pb2 as messages
from recorder.samples import SampleSeries

PERIOD = 6_000_000_000


def sample(row: int, sequence: int | None = None, **given: float | str) -> messages.Sample:
    stamps = {"time_ns": 100 + row * PERIOD, "sequence": row if sequence is None else sequence}
    return messages.Sample(**{**stamps, "value": float(row), "quality": messages.QUALITY_GOOD, **given})  # type: ignore[arg-type]


def test_samples_are_collected_by_run_and_signal() -> None:
    series = SampleSeries()
    for row, sequence in enumerate((*range(5), *range(6))):
        for signal in ("qc", "T"):
            series.add(signal, sample(row, sequence, unit="K"))
    assert [{name: list(values) for name, (_, values) in run.items()} for run in series.runs] == [
        {"qc": [0.0, 1.0, 2.0, 3.0, 4.0], "T": [0.0, 1.0, 2.0, 3.0, 4.0]},
        {"qc": [5.0, 6.0, 7.0, 8.0, 9.0, 10.0], "T": [5.0, 6.0, 7.0, 8.0, 9.0, 10.0]},
    ]
    assert series.units == {"qc": "K", "T": "K"}


def test_a_stray_is_left_out() -> None:
    series = SampleSeries()
    for row in range(10):
        series.add("T", sample(row, 7_000 if row == 5 else None, **({"time_ns": 7} if row == 5 else {})))
    (run,) = [run for run in series.runs if any(times for times, _ in run.values())]
    assert list(run["T"][1]) == [0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 7.0, 8.0, 9.0]
    assert series.splitter.strays == 1


@pytest.mark.parametrize(
    "given", [{"quality": messages.QUALITY_BAD}, {"value": math.inf}, {"value": math.nan}, {"value": -1e300}]
)
def test_a_value_that_cannot_be_one_counts_as_not_measured(given: dict[str, Any]) -> None:
    series = SampleSeries()
    series.add("T", sample(0, **given))
    assert [math.isnan(value) for value in series.runs[0]["T"][1]] == [True]


def test_a_message_without_quality_is_no_sample() -> None:
    series = SampleSeries()
    series.add("T", sample(0, quality=messages.QUALITY_UNSPECIFIED))
    assert series.runs == []
