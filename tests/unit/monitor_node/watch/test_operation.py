"""Roles, bounds and resolutions of signals: what the monitor knows of a plant's operation goes with its alarms."""

import msgspec
import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.replay import backtest
from monitor_node.replay.verification import verify
from monitor_node.watch.operation import Operation
from monitor_node.watched_process import SignalRange, signal_settings
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, Estimate, Quality, Sample
from reactorwatch.description.process import Process, Signal
from reactorwatch.errors import InputError
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.runtime.config import section

from ..test_many_inputs import FAULT_ROW, ROW_NS, ROWS, START_NS, linear_plant, live, recording

CONFIG = linear_plant(2, 2, seed=1).config(
    setpoints=("sp",), modes=("auto",), labels=("lab",), bounds={"u0": (-2.0, 1.7)}, units={"sp": "K", "u0": "l/h"}
)


def carried(signal: str, row: float, value: float) -> Encoded:
    """A sample of a signal beside the rows."""
    sample = Sample(time_ns=START_NS + int(row * ROW_NS), value=value, quality=Quality.QUALITY_GOOD)
    return encode(Publication(keys.key("cstr", keys.SAMPLE, signal), sample))


def messages() -> list[Encoded]:
    """A plant whose fault comes after its set point moved, and a pump saturated."""
    plant = linear_plant(2, 2, seed=1)
    plant.values[FAULT_ROW - 1 :, 0] = 1.7
    events = [
        (0.0, "sp", 20.0), (0.0, "auto", 1.0), (60.0, "lab", 7.0),
        (FAULT_ROW - 10.0, "sp", 22.0), (FAULT_ROW - 8.5, "sp", 25.0),
    ]  # fmt: skip
    beside = [(START_NS + int(row * ROW_NS), carried(signal, row, value)) for row, signal, value in events]
    rows = [(number // 4 * ROW_NS + START_NS, message) for number, message in enumerate(plant.messages())]
    return [message for _, message in sorted(beside + rows, key=lambda item: item[0])]


def alarms(publications: list[Publication]) -> list[Alarm]:
    return [item.message for item in publications if isinstance(item.message, Alarm)]


def test_an_alarm_states_saturation_and_a_moved_set_point() -> None:
    monitor = Monitor(msgspec.structs.replace(CONFIG, reference="arx"), START_NS)
    told = alarms(live(monitor, messages()))
    first = next(alarm for alarm in told if alarm.event == "raised" and alarm.time_ns >= START_NS + FAULT_ROW * ROW_NS)
    since_min = (first.time_ns - START_NS) / MINUTE_NS - (FAULT_ROW - 10) * 0.1
    assert first.text.endswith(
        f"; u0 is at its upper bound, 1.7 l/h; sp moved from 20 to 25 K, from {since_min:.3g} min before on"
    )
    assert monitor.rows == ROWS
    assert monitor.intake.rejects.by_reason == {}


def test_texts_are_the_same_live_resumed_replayed_and_back_tested() -> None:
    monitor, published = Monitor(CONFIG, START_NS), messages()
    told = [live(monitor, [message]) for message in published]
    again, resumed = Monitor(CONFIG, START_NS), []
    for first in range(0, len(published), 60):
        later = Monitor(CONFIG, START_NS)
        later.from_bytes(again.to_bytes())
        later.on_history_end()
        again = later
        resumed += [live(again, [message]) for message in published[first : first + 60]]
    assert resumed == told
    result = backtest.run(published, CONFIG)
    texts = [alarm.text for item in told for alarm in alarms(item)]
    assert [alarm.text for alarm in result.alarm_messages][: len(texts)] == texts
    log = recording(CONFIG, published)
    assert verify(lambda: log, CONFIG).exact


def test_a_move_in_steps_is_one_move_and_an_old_one_is_not_stated() -> None:
    config = MonitorConfig(setpoints=("sp",), incident_min=60.0)
    operation = Operation(config, [SignalRange()], {"sp": "K"})
    for minute, value in ((0, 10.0), (100, 11.0), (100.5, 12.0), (101, 12.0), (101.4, 14.0), (99, 90.0)):
        operation.on_sample("sp", int(minute * MINUTE_NS), value)
    assert operation.describe(103 * MINUTE_NS) == "sp moved from 10 to 14 K, from 3 min before on"
    assert operation.describe(161 * MINUTE_NS) != ""
    assert operation.describe(162 * MINUTE_NS) == ""


@pytest.mark.parametrize("reference", ["arx", "equations"])
def test_values_beyond_the_bounds_are_missing_to_the_models_and_raise_an_alarm(reference: str) -> None:
    """Values of inputs and outputs, in the training and after it, with any model."""
    signals = ("Q1", "Q2", "h1", "h2", "h3")
    generator = np.random.default_rng(3)
    values = np.array([21.37, 53.8, 41.0, 32.0, 36.6]) + generator.normal(size=(ROWS, 5)) * (0.2, 0.2, 0.1, 0.1, 0.1)
    absent = values.copy()
    for row, column in ((30, 2), (50, 0), (100, 0), (110, 3), (150, 4)):
        values[row, column], absent[row, column] = 50.0 if column != 0 else 45.0, np.nan
    bounds = dict.fromkeys(signals[2:], (10.0, 45.0)) | {"Q1": (0.0, 40.0)}
    config = MonitorConfig(
        inputs=signals[:2], outputs=signals[2:], training_min=8.0, bounds=bounds, isolation=False, priorities={},
        smallest_sd={}, diagnose_training=False, reference=reference,  # type: ignore[arg-type]
    )  # fmt: skip
    told = []
    for rows in (values, absent):
        plant = linear_plant(2, 3, seed=0)
        plant = type(plant)(signals[:2], signals[2:], rows)
        model = three_tanks() if reference == "equations" else None
        told.append(live(Monitor(config, START_NS, model=model), plant.messages()))
    raised = [(a.alarm, (a.time_ns - START_NS) // ROW_NS) for a in alarms(told[0]) if a.event == "raised"]
    assert raised[:5] == [("range/h1", 30), ("range/Q1", 50), ("range/Q1", 100), ("range/h2", 110), ("range/h3", 150)]
    estimates = [
        {(item.key, item.message.time_ns): item.message for item in published if isinstance(item.message, Estimate)}
        for published in told
    ]
    assert estimates[0] == estimates[1]


def test_a_stated_resolution_shows_a_stuck_sensor_behind_rounding_and_a_constant_one_is_watched() -> None:
    """An output with steps of a quarter whose numbers were converted on their way, so that no two are equal."""
    generator = np.random.default_rng(8)
    plant = linear_plant(1, 2, seed=8)
    coarse = np.round(4.0 * generator.normal(size=ROWS)) / 4.0
    coarse[150:] = coarse[150]
    plant.values[:, 1] = coarse + generator.uniform(-1e-7, 1e-7, ROWS)
    plant.values[:, 2] = 5.0
    plant.values[170:, 2] = 6.0
    for resolution, is_seen in (({}, False), ({"y0": 0.25, "y1": 0.25}, True)):
        result = backtest.run(plant.messages(), plant.config(resolution=resolution))
        raised = [alarm.alarm for alarm, _ in result.raised_alarms]
        assert ("stuck/y0" in raised) is is_seen
        assert ("y1" in result.exclusions) is not is_seen
        assert ("shewhart/y1" in raised) is is_seen


def test_the_settings_of_a_described_process_are_in_the_units_in_which_it_is_judged() -> None:
    process = Process(
        "rig",
        (
            Signal("Q2", "cm3/s", "input"),
            Signal("Q1", "l/h", "input", bounds=(0.0, 540.0)),
            Signal("h1", "mm", "output", resolution=2.0, bounds=(0.0, 620.0)),
            Signal("h2", "cm", "output"),
            Signal("h3", "cm", "output"),
            Signal("room", "degC", "output"),
            Signal("sp1", "mm", "setpoint"),
            Signal("auto", "", "mode"),
            Signal("fault", "", "label"),
        ),
        three_tanks(),
    )
    found = signal_settings(process)
    assert found["bounds"]["Q1"] == pytest.approx((0.0, 150.0))
    assert found["bounds"]["h1"] == pytest.approx((0.0, 62.0))
    assert found["resolution"] == {"h1": pytest.approx(0.2)}
    roles = ("inputs", "outputs", "setpoints", "modes", "labels")
    assert [found[role] for role in roles] == [
        ("Q1", "Q2"), ("h1", "h2", "h3"), ("sp1",), ("auto",), ("fault", "room"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ({"setpoints": ["T"]}, "each signal have one role"),
        ({"bounds": {"x": [0, 1]}}, "bounds are by input and output"),
        ({"bounds": {"T": [1, 1]}}, "bounds of T must be a lower and a higher number, got 1 and 1"),
        ({"resolution": {"qc": 1.0}}, "resolution is by output"),
        ({"resolution": {"T": 0.0}}, r"resolution of T must be in \(0, 1e6\), got 0"),
    ],
)
def test_a_role_or_a_bound_that_cannot_be_is_one_line(setting: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        section(MonitorConfig, "monitor", {"monitor": setting}, {})
