"""The reference that judges is named, and the predictions of the recursive ARX model beside it are drawn."""

import numpy as np
import pytest

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Publication, encode
from recorder import RecordedMessage
from recorder.columns import ADAPTIVE, RunColumns, read_run, read_segments
from recorder.panels import signals
from recorder.panels.base import TimePlot

ROWS = 5


def estimate(row: int, prediction: float) -> messages.Estimate:
    return messages.Estimate(time_ns=row, prediction=prediction, residual=0.5, unit="K")


def entries() -> list[RecordedMessage]:
    published = []
    for row in range(1, ROWS + 1):
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
def run() -> RunColumns:
    return read_run(entries())


def test_both_predictions_are_drawn_and_the_one_that_judges_is_named(run: RunColumns) -> None:
    (plot,) = [item for item in signals.draw_overview(run) if isinstance(item, TimePlot)]
    legends = {series.name: series.legend for series in plot.series}
    assert legends["predicted"] == "predicted by black-box"
    assert legends["predicted beside"] == "arx, for comparison"
    beside = next(series for series in plot.series if series.name == "predicted beside")
    np.testing.assert_array_equal(beside.value, 400.0 + np.arange(1, ROWS + 1))
    assert [item.title for item in signals.draw_charts(run)] == ["Residual of T"]


def test_a_recursive_model_that_judges_is_drawn_as_one_that_adapts(run: RunColumns) -> None:
    assert list(run.models) == [("T", ADAPTIVE)]


def test_the_reference_is_known_in_later_segments() -> None:
    segments = list(read_segments(entries(), 3))
    assert [segment.reference for segment in segments][-1] == "black-box"
