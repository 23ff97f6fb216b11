"""Samples are judged in the units of their process, in whatever unit they come."""

from math import inf, nan

import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.ingest.intake import RejectCounter, SampleUnits, UnusableSamples, reject_reason
from monitor_node.replay.backtest import run
from monitor_node.watched_process import watch_process
from reactorwatch.contract.codec import encode
from reactorwatch.contract.messages_pb2 import Quality, Sample
from reactorwatch.description.process import Process, Signal
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record
from recorder.tools.player import samples_of

from ..samples import leaking_run, sample

DECLARED = {"qc": "l/h", "C": "mol/m^3", "T": "degC"}


@pytest.mark.parametrize(
    ("unit", "value", "expected"),
    [
        ("degC", 20.0, (293.15, "K")),
        ("", 20.0, (293.15, "K")),  # as declared
        ("K", 20.0, (20.0, "K")),
        ("kelvin", 20.0, (20.0, "kelvin")),
    ],
)
def test_a_sample_is_converted_to_the_unit_of_the_equations(
    unit: str, value: float, expected: tuple[float, str]
) -> None:
    units = SampleUnits({"T": "degC"}, {"T": "K"})
    assert units.convert("T", unit, value) == expected
    assert units.convert("T2", unit, value) == (value, unit)


@pytest.mark.parametrize("unit", ["bar", "of its own"])
def test_a_unit_that_is_unknown_or_of_another_quantity_is_refused_and_without_units_nothing_is_converted(
    unit: str,
) -> None:
    units = SampleUnits({"T": "degC"}, {})
    for _ in range(2):
        with pytest.raises(InputError, match=f"sample of T: unit must convert to 'degC', got '{unit}'"):
            units.convert("T", unit, 1.0)
    assert SampleUnits({}, {}).convert("T", unit, 1.0) == (1.0, unit)


@pytest.mark.parametrize("names_units", [True, False])
def test_a_plant_in_units_of_its_own_raises_the_alarms_of_one_in_those_of_the_equations(names_units: bool) -> None:
    """Alarms name the units of the equations."""
    time_min, columns = leaking_run(-0.1, 25.0, 40.0, 4)
    model = cstr()
    signals = [Signal(name, DECLARED[name], "input" if name == "qc" else "output") for name in columns]
    rig = Process("rig", tuple(signals), model)
    own = {"qc": columns["qc"] * 60.0, "C": columns["C"] * 1000.0, "T": columns["T"] - 273.15}
    config = MonitorConfig(training_min=20.0, isolation=False, reference="equations")
    found = []
    for values, units in ((columns, model.units), (own, DECLARED if names_units else {})):
        watched = watch_process(config, rig)
        record = Record(time_min, {name: np.asarray(item) for name, item in values.items()}, "run", units=units)
        result = run((encode(item) for item in samples_of(record, "cstr")), watched.config, 0, watched.model)
        found.append([(alarm.alarm, alarm.raised_ns) for alarm, _ in result.raised_alarms])
        assert all(" degC" not in alarm.text for alarm, _ in result.raised_alarms)
    assert found[0]
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("quality", "value", "reason", "text"),
    [
        (Quality.QUALITY_UNSPECIFIED, 1.0, "payload", "T: the sample has no quality"),
        (Quality.QUALITY_GOOD, nan, "not_finite", "T is nan at 7 ns"),
        (Quality.QUALITY_BAD, -inf, "not_finite", "T is -inf at 7 ns"),
        (Quality.QUALITY_BAD, 1.0, "bad_quality", "T is marked bad at 7 ns"),
        (9, 1.0, "bad_quality", "T has the quality 9, which this version does not know"),
        (Quality.QUALITY_GOOD, 1e15, "out_of_range", "T is 1000000000000000.0 at 7 ns: sizes must be below 1e+15"),
        (Quality.QUALITY_UNCERTAIN, -2e15, "out_of_range", "sizes must be below 1e+15"),
    ],
)
def test_the_reason_of_a_reject_is_what_is_wrong_with_the_sample(
    quality: Quality, value: float, reason: str, text: str
) -> None:
    found, description = reject_reason("T", Sample(time_ns=7, value=value, quality=quality))
    assert found == reason
    assert text in description


def test_a_unit_that_needs_no_conversion_is_noted_and_one_that_does_is_not() -> None:
    units = SampleUnits({"T": "degC", "p": "bar"}, {"T": "K"})
    for unit, plain in (("degC", {}), ("", {}), ("K", {"T": "K"})):
        units.convert("T", unit, 20.0)
        assert units.plain == plain
    assert units.convert("p", "bar", 2.0) == (2.0, "bar")
    assert units.plain == {"T": "K", "p": "bar"}


def test_publishers_that_name_ever_more_units_take_no_more_memory() -> None:
    """Each is refused still, and the units known before are converted."""
    units = SampleUnits({"T": "degC"}, {"T": "K"})
    units.convert("T", "degC", 20.0)
    for number in range(1500):
        with pytest.raises(InputError, match="unit must convert"):
            units.convert("T", f"nonsense {number}", 1.0)
    assert len(units._conversions) == 1000
    assert units.convert("T", "degC", 20.0) == (293.15, "K")


def test_rejects_are_reported_by_reason_at_most_once_a_minute() -> None:
    minute_ns, rejects = 60_000_000_000, RejectCounter()
    assert rejects.report(0) is None
    rejects.add("unit", "the first")
    rejects.add("unit", "the second")
    rejects.add("payload", "another")
    assert rejects.report(5) == "refused messages: unit (2 so far): the first; payload (1 so far): another"
    rejects.add("unit", "the third")
    assert rejects.report(5 + minute_ns - 1) is None
    assert rejects.report(5 + minute_ns) == "refused messages: unit (3 so far): the third"
    assert rejects.report(5 + 9 * minute_ns) is None
    assert rejects.by_reason == {"unit": 3, "payload": 1}
    assert rejects.total == 4


def test_an_example_of_more_than_300_characters_is_truncated_and_ends_in_three_dots() -> None:
    for length, shown in ((300, "x" * 300), (301, "x" * 300 + "...")):
        rejects = RejectCounter()
        rejects.add("unit", "x" * length)
        assert rejects.report(0) == f"refused messages: unit (1 so far): {shown}"


def test_unusable_samples_are_counted_until_a_usable_one_of_any_signal() -> None:
    unusable = UnusableSamples()
    unusable.add("T", "t" * 301)
    unusable.add("C", "bad")
    unusable.add("C", "worse")
    assert unusable.reasons == {"T": "t" * 300, "C": "worse"}
    assert unusable.in_a_row == 3
    unusable.clear("T")
    assert unusable.reasons == {"C": "worse"}
    assert unusable.in_a_row == 0
    unusable.clear("T")
    unusable.add("C", "bad")
    assert unusable.in_a_row == 1


@pytest.mark.parametrize(("size", "refused"), [(1000, {}), (1001, {"too_large": 1})])
def test_a_payload_of_more_than_1000_bytes_is_no_sample(size: int, refused: dict[str, int]) -> None:
    monitor = Monitor(MonitorConfig(), 0)
    message = sample("T", 0, 0.0, 440.0)
    filling = b"\xfa\x7f"  # a field of a later schema, and its length in two bytes
    rest = size - len(message.payload) - 4
    payload = message.payload + filling + bytes((rest & 127 | 128, rest >> 7)) + b"x" * rest
    assert len(payload) == size
    monitor.on_message(message._replace(payload=payload), 0)
    assert monitor.intake.rejects.by_reason == refused


@pytest.mark.parametrize(
    ("number", "time_ns", "is_refused"),
    [(2**62 - 1, 2**62 - 1, False), (2**62, 0, True), (0, 2**62, True), (0, 1 - 2**62, False), (0, -(2**62), True)],
)
def test_numbers_and_times_beyond_2_to_the_62_are_of_no_plant(number: int, time_ns: int, *, is_refused: bool) -> None:
    monitor = Monitor(MonitorConfig(), 0)
    message = Sample(time_ns=time_ns, sequence=number, value=440.0, unit="K", quality=Quality.QUALITY_GOOD)
    monitor.on_sample("T", message, 0)
    assert monitor.intake.rejects.by_reason == ({"out_of_range": 1} if is_refused else {})
