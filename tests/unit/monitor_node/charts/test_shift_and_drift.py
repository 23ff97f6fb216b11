"""A lasting step of a measurement is seen where the reference predicts from the last measurements, and follows it.

The limits of the drift are prepared for every memory that the adaptive models may come to have.
"""

import numpy as np
import pytest

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.charts import shift_and_drift as drift
from monitor_node.config import MonitorConfig, ReferenceName
from monitor_node.core import Monitor
from monitor_node.learn.arx import JUDGING_FORGETTING, arx_structure
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, ChartPoint
from reactorwatch.spc.charts.parameters import adaptive_weight, parameter_limit
from tests.exchanger import Result, config_of, random_exchanger, simulate, watch

from ..samples import feed_row, leaking_run, samples

ROWS, SECOND_NS = 1500, 10**9
SIZES = (2.0, -2.0, 4.0, -20.0)
ONSETS = (1110, 1237, 1301, 1399, 1444)
PLANTS = (0, 5, 11)


def exchanger(seed: int, rows: int = ROWS) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    return simulate(random_exchanger(rng), rows, rng)


def take(monitor: Monitor, row: int, values: tuple[float, float]) -> list[Publication]:
    return feed_row(monitor, row, row * SECOND_NS, values)


@pytest.fixture(scope="module", params=["arx", "black-box"])
def results(request: pytest.FixtureRequest) -> list[Result]:
    config = config_of(request.param)
    found = [watch(*exchanger(seed), config, SIZES, ONSETS) for seed in PLANTS]
    assert {result.reference for result in found} == {request.param}
    return found


def test_a_lasting_step_of_any_size_above_the_noise_is_seen_within_20_rows(results: list[Result]) -> None:
    for result in results:
        assert not any(result.missed.values()), result.missed
        assert all(len(delays) == len(ONSETS) for delays in result.delays.values())


def test_a_sound_record_raises_no_alarm_of_a_step(results: list[Result]) -> None:
    assert not [name for result in results for name in result.false_alarms if name.startswith("shift/")]


@pytest.mark.parametrize("reference", ["arx", "black-box"])
def test_a_stepped_plant_resumes_bit_for_bit_and_names_its_signal_and_size(reference: ReferenceName) -> None:
    flow, measured = exchanger(0, 1100)
    measured = measured + 3.0 * (np.arange(1100) >= 1050)
    first, before, raised = Monitor(config_of(reference), 0), b"", []
    for k, values in enumerate(zip(flow.tolist(), measured.tolist(), strict=True)):
        publications = take(first, k, values)
        if k >= 1045:
            second = Monitor(config_of(reference), 0)
            second.from_bytes(before)
            second.on_history_end()
            assert take(second, k, values) == publications
            assert second.to_bytes() == first.to_bytes()
            raised += [item.message for item in publications if isinstance(item.message, Alarm)]
        if k >= 1044:
            before = first.to_bytes()
    (alarm,) = [item for item in raised if item.alarm == "shift/th" and item.event == "raised"]
    assert 1050 * SECOND_NS < alarm.time_ns <= 1070 * SECOND_NS
    assert "th moved by +" in alarm.text
    assert [item.signal for item in alarm.contributions] == ["th"]


def test_the_equations_follow_no_measurement_and_have_no_such_chart() -> None:
    monitor = Monitor(MonitorConfig(training_min=60.0, diagnose_training=False), 0)
    points = set()
    for message in samples(*leaking_run(0.0, 1e3, 62.0, 0)):
        for item in monitor.on_message(message, 0):
            if isinstance(item.message, ChartPoint):
                points.add(item.key)
    assert points
    assert not [key for key in points if "/shift/" in key]


@pytest.mark.parametrize("reference", ["arx", "black-box"])
def test_a_step_in_rows_that_are_not_judged_is_seen(reference: ReferenceName) -> None:
    """The flow moves little in the training, so many later rows are extrapolations; nine of ten steps are seen."""
    rng = np.random.default_rng(5)
    plant = random_exchanger(rng)
    flow, measured = simulate(plant, 1800, rng, calm=1000)
    monitor, unjudged = Monitor(config_of(reference), 0), []
    for k, values in enumerate(zip(flow.tolist(), measured.tolist(), strict=True)):
        publications = take(monitor, k, values)
        if 1050 < k < 1780 and not any(item.key.endswith("/estimate/th") for item in publications):
            unjudged.append(k)
    assert len(unjudged) >= 10
    onsets = unjudged[:: len(unjudged) // 10][:10]
    result = watch(flow, measured, config_of(reference), [3.0], onsets)
    assert len(result.delays[3.0]) >= 8
    assert len(result.missed[3.0]) <= 0.1 * len(result.delays[3.0])


@pytest.mark.parametrize(
    ("reference", "memories"),
    [
        ("auto", {0.99, JUDGING_FORGETTING}),
        ("arx", {JUDGING_FORGETTING}),
        ("equations", {0.99}),
        ("black-box", {0.99}),
    ],
)
def test_no_limit_is_computed_after_the_preparation(
    monkeypatch: pytest.MonkeyPatch, reference: ReferenceName, memories: set[float]
) -> None:
    config = MonitorConfig(reference=reference, forgetting=0.99, order=1)
    for _ in drift.preparation(config, wanted=True):
        pass

    def fail(*_: object) -> float:
        raise AssertionError("computed again")

    monkeypatch.setattr("reactorwatch.spc.charts.parameters.mewma_run_length", fail)
    for forgetting in memories:
        assert parameter_limit(1e5, arx_structure(config).parameters, adaptive_weight(forgetting), 500.0, 0.1) > 0.0


def test_nothing_is_prepared_for_a_drift_that_has_no_limit() -> None:
    assert list(drift.preparation(MonitorConfig(), wanted=False)) == []
    with_alarm = MonitorConfig(charts=("ewma", "parameters"))
    assert drift.DriftWatch(with_alarm, Annunciator(with_alarm), publish=False).wanted
    assert next(drift.preparation(with_alarm, wanted=False), "nothing") is None
