"""A recording as columns."""

import numpy as np
import pytest

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.errors import InputError
from recorder.entry import Entry
from recorder.run import Run, read_run
from tests.unit.recorder import golden


@pytest.fixture(scope="module")
def run() -> Run:
    return read_run(golden.entries())


ROWS = np.arange(golden.ROWS)
TIMES = np.array([golden.time_ns(row) for row in range(golden.ROWS)])


def test_measured_values_are_those_published(run: Run) -> None:
    assert sorted(run.measured) == ["C", "T", "qc"]
    for signal, measured in run.measured.items():
        assert np.array_equal(measured.time_ns, TIMES)
        assert measured.value.tolist() == [golden.value(signal, row) for row in range(golden.ROWS)]
    assert run.plant == "cstr"
    assert run.units == {"qc": "l/min", "C": "mol/l", "T": "K"}
    assert run.span_ns == (TIMES[0], TIMES[-1])


def test_estimates_have_limits_once_these_are_learned(run: Run) -> None:
    assert sorted(run.estimated) == ["C", "T"]
    learned = ROWS * golden.STEP_MIN >= golden.LEARNED_MIN
    for signal, estimated in run.estimated.items():
        expected = np.array([golden.expected(signal, row) for row in range(golden.ROWS)])
        assert np.array_equal(estimated.prediction, expected)
        assert np.array_equal(estimated.residual, run.measured[signal].value - expected)
        assert np.array_equal(np.isfinite(estimated.upper_limit), learned)
        limit = 3.0 * golden.NOISE[signal]
        assert estimated.residual_upper_limit[learned] == pytest.approx(limit, rel=1e-9)
        assert estimated.residual_lower_limit[learned] == pytest.approx(-limit, rel=1e-9)


def test_chart_points_alarms_and_faults_are_there(run: Run) -> None:
    chart = run.charts["shewhart/T"]
    assert chart.time_ns.size == np.sum(ROWS * golden.STEP_MIN >= golden.LEARNED_MIN)
    assert np.array_equal(chart.out == 1.0, np.abs(chart.statistic) > 3.0)
    assert [(change.alarm, change.state) for change in run.alarms] == [
        ("shewhart/T", messages.ALARM_STATE_UNACKNOWLEDGED),
        ("shewhart/T", messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED),
    ]
    assert [(fault.cause, fault.active) for fault in run.faults] == [("coolant_flow", True)]


def test_the_order_of_receipt_does_not_matter(run: Run) -> None:
    backwards = read_run(reversed(list(golden.entries())))
    assert np.array_equal(backwards.measured["T"].value, run.measured["T"].value)
    assert np.array_equal(backwards.estimated["C"].residual, run.estimated["C"].residual)
    assert backwards.alarms == run.alarms


def test_unusable_values_are_gaps_and_what_cannot_be_read_is_passed_over() -> None:
    key = "reactor/cstr/sample/T"
    bad = messages.Sample(time_ns=1, value=5.0, quality=messages.QUALITY_BAD, unit="K")
    infinite = messages.Sample(time_ns=2, value=np.inf, quality=messages.QUALITY_GOOD)
    run = read_run(
        [
            encode(Publication(key, bad)),
            encode(Publication(key, infinite)),
            encode(Publication(key, messages.Fault(time_ns=3))),
            encode(Publication(key, messages.Sample(time_ns=4))),  # without a quality it is no sample
            Encoded(key, b"\xff\xff", "application/protobuf;reactorwatch.v1.Sample"),
            Entry("reactor/other/sample/T", b"", "text/plain", 0, 0),
            Entry("reactor", b"", "text/plain", 0, 0),
        ]
    )
    assert np.isnan(run.measured["T"].value).tolist() == [True, True]
    assert (run.plant, run.faults) == ("cstr", ())


def test_a_run_of_nothing_is_a_run() -> None:
    run = read_run([])
    assert (run.plant, run.measured, run.alarms, run.span_ns) == ("", {}, (), (0, 0))


def test_a_run_is_of_one_plant() -> None:
    other = [entry._replace(key=entry.key.replace("cstr", "b")) for entry in golden.entries()]
    with pytest.raises(InputError, match="a run is of one plant; name one of b, cstr"):
        read_run([*golden.entries(), *other])
