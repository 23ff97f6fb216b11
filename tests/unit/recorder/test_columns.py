"""A recording as columns, with the predictions of the reference that judges and of the one beside it."""

import numpy as np
import pytest

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.errors import InputError
from recorder import RecordedMessage
from recorder.columns import ADAPTIVE, EQUATIONS, FROZEN, REFERENCE, RunColumns, SegmentContext, read_run, read_segments
from recorder.panels import signals
from recorder.panels.base import TimePlot
from tests.unit.recorder import golden


@pytest.fixture(scope="module")
def run() -> RunColumns:
    return read_run(golden.entries())


ROWS = np.arange(golden.ROWS)
TIMES = np.array([golden.time_ns(row) for row in range(golden.ROWS)])


def test_measured_values_are_those_published(run: RunColumns) -> None:
    assert sorted(run.samples) == ["C", "T", "qc"]
    for signal, measured in run.samples.items():
        assert np.array_equal(measured.time_ns, TIMES)
        assert measured.value.tolist() == [golden.value(signal, row) for row in range(golden.ROWS)]
    assert run.plant == "cstr"
    assert run.units == {"qc": "l/min", "C": "mol/l", "T": "K"}
    assert run.span_ns == (TIMES[0], TIMES[-1])


def test_estimates_have_limits_once_these_are_learned(run: RunColumns) -> None:
    assert sorted(run.estimates) == ["C", "T"]
    learned = ROWS * golden.STEP_MIN >= golden.LEARNED_MIN
    for signal, estimated in run.estimates.items():
        expected = np.array([golden.expected(signal, row) for row in range(golden.ROWS)])
        assert np.array_equal(estimated.prediction, expected)
        assert np.array_equal(estimated.residual, run.samples[signal].value - expected)
        assert np.array_equal(np.isfinite(estimated.upper_limit), learned)
        limit = 3.0 * golden.NOISE[signal]
        lower, upper = estimated.residual_limits
        assert upper[learned] == pytest.approx(limit, rel=1e-9)
        assert lower[learned] == pytest.approx(-limit, rel=1e-9)


def test_chart_points_alarms_and_faults_are_there(run: RunColumns) -> None:
    chart = run.charts["shewhart/T"]
    assert chart.time_ns.size == np.sum(ROWS * golden.STEP_MIN >= golden.LEARNED_MIN)
    assert np.array_equal(chart.out == 1.0, np.abs(chart.statistic) > 3.0)
    assert [(change.alarm, change.state) for change in run.alarms] == [
        ("shewhart/T", messages.ALARM_STATE_UNACKNOWLEDGED),
        ("shewhart/T", messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED),
    ]
    assert [(fault.cause, fault.active) for fault in run.faults] == [("coolant_flow", True)]


def test_the_order_of_receipt_does_not_matter(run: RunColumns) -> None:
    backwards = read_run(reversed(list(golden.entries())))
    assert np.array_equal(backwards.samples["T"].value, run.samples["T"].value)
    assert np.array_equal(backwards.estimates["C"].residual, run.estimates["C"].residual)
    assert backwards.alarms == run.alarms


def test_messages_that_a_restarted_monitor_publishes_again_count_once(run: RunColumns) -> None:
    twice = [entry for entry in golden.entries() for _ in range(2)]
    assert read_run(twice).alarms == run.alarms


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
            RecordedMessage("reactor/other/sample/T", b"", "text/plain", 0, 0),
            RecordedMessage("reactor", b"", "text/plain", 0, 0),
        ]
    )
    assert np.isnan(run.samples["T"].value).tolist() == [True, True]
    assert (run.plant, run.faults) == ("cstr", ())


def test_a_run_of_nothing_is_a_run() -> None:
    run = read_run([])
    assert (run.plant, run.samples, run.alarms, run.span_ns) == ("", {}, (), (0, 0))


def test_a_run_is_of_one_plant() -> None:
    other = [entry._replace(key=entry.key.replace("cstr", "b")) for entry in golden.entries()]
    with pytest.raises(InputError, match="a run is of one plant; name one of b, cstr"):
        read_run([*golden.entries(), *other])


def test_stretches_hold_the_run_and_each_message_once(run: RunColumns) -> None:
    parts = list(read_segments(golden.entries(), 111))
    assert len(parts) > 15
    for signal, measured in run.samples.items():
        found = [part.samples[signal] for part in parts if signal in part.samples]
        assert np.array_equal(np.concatenate([item.time_ns for item in found]), measured.time_ns)
        assert np.array_equal(np.concatenate([item.value for item in found]), measured.value)
    assert [change for part in parts for change in part.alarms] == list(run.alarms)
    assert [change for part in parts for change in part.faults] == list(run.faults)
    assert [report.phase for part in parts for report in part.health.get("monitor", ())] == [
        report.phase for report in run.health["monitor"]
    ]


def test_a_stretch_knows_what_was_before_it(run: RunColumns) -> None:
    parts = list(read_segments(golden.entries(), 500))
    assert parts[0].context == SegmentContext()
    for number, part in enumerate(parts[1:], start=1):
        assert part.first_ns == run.first_ns == TIMES[0]
        before = [item.samples["T"] for item in parts[:number]]
        newest = np.concatenate([item.value for item in before])[-2:]
        assert np.array_equal(part.context.last_samples["T"].value, newest)
    states = [part.context.alarm_states.get("shewhart/T") for part in parts]
    assert states[0] is None
    assert states[-1] == messages.ALARM_STATE_UNACKNOWLEDGED, "it clears in the last"
    onset_ns = golden.time_ns(round(golden.ONSET_MIN / golden.STEP_MIN))
    assert (parts[0].context.onset_ns, parts[-1].context.onset_ns) == (None, onset_ns)


def test_what_has_been_seen_of_a_signal_does_not_depend_on_the_stretches(run: RunColumns) -> None:
    (*_, last) = read_segments(golden.entries(), 97)
    for signal, measured in run.samples.items():
        seen = last.statistics[signal]
        assert seen.rows == golden.ROWS
        assert seen.mean == pytest.approx(measured.value.mean(), rel=1e-12)
        assert (seen.lowest, seen.highest) == (measured.value.min(), measured.value.max())


def test_a_node_s_report_stands_at_the_newest_sample_of_its_receipt(run: RunColumns) -> None:
    """A node speaks by the clock; at an accelerated plant that is another time than the run's."""
    rows = [row for row in range(golden.ROWS) if row % 50 == 0]
    assert [report.time_ns for report in run.health["monitor"]] == [golden.time_ns(row) for row in rows]


def test_models_are_distinguished_by_their_purpose() -> None:
    parameter = messages.Parameter(name="a1", value=0.9, sd=0.1)
    published = [
        messages.ModelSnapshot(time_ns=at, parameters=[parameter], excitation=0.1 * at, reference=reference, held=held)
        for at, reference, held in ((1, False, False), (2, False, False), (2, True, False), (3, False, True))
    ]
    published.append(messages.ModelSnapshot(time_ns=4, structure="equations", reference=True, held=True))
    run = read_run(encode(Publication("reactor/cstr/model/T", item)) for item in published)
    assert [item.time_ns for item in run.models["T", ADAPTIVE]] == [1, 2]
    assert [item.time_ns for item in run.models["T", FROZEN]] == [3]
    assert [item.time_ns for item in run.models["T", EQUATIONS]] == [4]
    (judged,) = run.models["T", REFERENCE]
    assert list(judged.parameters) == [parameter]
    assert judged.excitation == pytest.approx(0.2)


def test_a_reconstruction_is_a_column_beside_its_signal() -> None:
    reported = [messages.Reconstruction(time_ns=at, value=440.0 + at, sd=0.5, unit="K") for at in (1, 2, 3)]
    run = read_run(encode(Publication("reactor/cstr/reconstruction/T", item)) for item in reported)
    assert run.reconstructions["T"].value.tolist() == [441.0, 442.0, 443.0]
    assert run.reconstructions["T"].sd.tolist() == [0.5, 0.5, 0.5]


SAMPLE_ROWS = 5


def estimate(row: int, prediction: float) -> messages.Estimate:
    return messages.Estimate(time_ns=row, prediction=prediction, residual=0.5, unit="K")


def judged_entries() -> list[RecordedMessage]:
    published = []
    for row in range(1, SAMPLE_ROWS + 1):
        sample = messages.Sample(time_ns=row, value=400.0, unit="K", quality=messages.QUALITY_GOOD)
        published += [
            Publication("reactor/cstr/sample/T", sample),
            Publication("reactor/cstr/estimate/T", estimate(row, 399.5)),
            Publication("reactor/cstr/estimate/T/arx", estimate(row, 400.0 + row)),
        ]
    published += [
        Publication(
            "reactor/cstr/health/monitor",
            messages.Health(time_ns=3, node="monitor", phase="watching", reference="black-box"),
        ),
        Publication("reactor/cstr/model/T", messages.ModelSnapshot(time_ns=3, structure="arx", reference=True)),
    ]
    return [RecordedMessage(*encode(item)[:3], item.message.time_ns, item.message.time_ns) for item in published]


@pytest.fixture(scope="module")
def judged_run() -> RunColumns:
    return read_run(judged_entries())


def test_both_predictions_are_drawn_and_the_one_that_judges_is_named(judged_run: RunColumns) -> None:
    (plot,) = [item for item in signals.draw_overview(judged_run) if isinstance(item, TimePlot)]
    legends = {series.name: series.legend for series in plot.series}
    assert legends["predicted"] == "predicted by black-box"
    assert legends["predicted beside"] == "arx, for comparison"
    beside = next(series for series in plot.series if series.name == "predicted beside")
    np.testing.assert_array_equal(beside.value, 400.0 + np.arange(1, SAMPLE_ROWS + 1))
    assert [item.title for item in signals.draw_charts(judged_run)] == ["Residual of T"]


def test_a_recursive_model_that_judges_is_drawn_as_one_that_adapts(judged_run: RunColumns) -> None:
    assert list(judged_run.models) == [("T", ADAPTIVE)]


def test_the_reference_is_known_in_later_segments() -> None:
    segments = list(read_segments(judged_entries(), 3))
    assert [segment.reference for segment in segments][-1] == "black-box"
