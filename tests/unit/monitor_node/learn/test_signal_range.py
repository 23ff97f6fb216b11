"""Values that the process cannot take are no measurements: they raise an alarm and reach no filter and no chart."""

from typing import Any

import casadi as ca
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.learn.process_reference import ProcessReference
from monitor_node.watched_process import ANY, signal_ranges
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, Sample
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.library.cstr import cstr
from tests.unit.process.effect_named import effect_of

from ..samples import leaking_run, samples

SIGNALS = ("qc", "C", "T")
CONFIG = MonitorConfig(training_min=20.0, isolation=False)
FIRST_BAD, BAD_ROWS = 240, 20


@pytest.fixture(scope="module")
def run() -> list[Encoded]:
    """A sound run of 30 minutes."""
    return list(samples(*leaking_run(0.0, 1.0, 30.0, seed=4)))


@pytest.fixture(scope="module")
def trained(run: list[Encoded]) -> bytes:
    """A monitor before the first bad row."""
    monitor = Monitor(CONFIG, 0, points=False)
    for message in run[: 3 * FIRST_BAD]:
        monitor.on_message(message, 0)
    return monitor.to_bytes()


def resumed(state: bytes) -> Monitor:
    monitor = Monitor(CONFIG, 0, points=False)
    monitor.from_bytes(state)
    monitor.on_history_end()
    return monitor


def fed(monitor: Monitor, messages: list[Encoded]) -> list[Alarm]:
    said: list[Publication] = [item for message in messages for item in monitor.on_message(message, 0)]
    said += monitor.finish()
    return [item.message for item in said if isinstance(item.message, Alarm)]


def with_value(message: Encoded, value: float) -> Encoded:
    sample = Sample.FromString(message.payload)
    sample.value = value
    return message._replace(payload=sample.SerializeToString())


def filter_state(monitor: Monitor) -> Any:
    reference = monitor.pipeline.evaluation.reference
    assert isinstance(reference, ProcessReference)
    return reference.memory


@settings(max_examples=15, deadline=None)
@given(signal=st.integers(0, 2), size=st.floats(1e-3, 1e15, exclude_max=True), above=st.booleans())
def test_any_value_out_of_range_is_as_good_as_missing_and_raises_one_alarm_at_once(
    run: list[Encoded], trained: bytes, signal: int, size: float, above: bool
) -> None:
    """Filter, charts and prewhitening remember what they do when the sample is not there."""
    lower, upper, _ = signal_ranges(cstr(), SIGNALS)[signal]
    value = upper + size if above else lower - size
    bad = range(3 * FIRST_BAD + signal, 3 * (FIRST_BAD + BAD_ROWS), 3)
    shown, missing = resumed(trained), resumed(trained)
    messages = run[3 * FIRST_BAD :]
    alarms = fed(shown, [with_value(m, value) if at in bad else m for at, m in enumerate(messages, 3 * FIRST_BAD)])
    fed(missing, [m for at, m in enumerate(messages, 3 * FIRST_BAD) if at not in bad])
    first = alarms[0]
    assert (first.alarm, first.event) == (f"range/{SIGNALS[signal]}", "raised")
    assert first.time_ns == FIRST_BAD * 6 * 10**9
    assert [item.cause for item in first.suspects] == ["out_of_range"]
    assert f"{SIGNALS[signal]} reads {value:.6g} " in first.text
    cleared = next(item for item in alarms if item.alarm == first.alarm and item.event == "cleared")
    assert cleared.time_ns == (FIRST_BAD + BAD_ROWS + CONFIG.clear_count - 1) * 6 * 10**9
    assert filter_state(shown) == filter_state(missing)
    learned = [replace(item.pipeline.memory.evaluation, signals={}).to_bytes() for item in (shown, missing)]
    assert learned[0] == learned[1]
    assert shown.failures.by_stage == {}


@pytest.mark.parametrize("reference", ["auto", "process"])
@pytest.mark.parametrize("signal", [0, 2])
def test_in_training_it_is_not_learned_from(run: list[Encoded], reference: Any, signal: int) -> None:
    """A training with twenty rows of 9999 ends as one in which these samples are missing.

    Where the plant is said to be the process there is an alarm already; else that is known when the training ends.
    """
    config = MonitorConfig(training_min=20.0, isolation=False, reference=reference)
    bad = range(3 * 100 + signal, 3 * 120, 3)
    shown, missing = Monitor(config, 0, points=False), Monitor(config, 0, points=False)
    alarms = fed(shown, [with_value(m, 9999.0) if at in bad else m for at, m in enumerate(run)])
    fed(missing, [m for at, m in enumerate(run) if at not in bad])
    events = [item.event for item in alarms if item.alarm == f"range/{SIGNALS[signal]}"]
    assert events == (["raised", "cleared"] if reference == "process" else [])
    assert filter_state(shown) == filter_state(missing)


def test_a_plant_that_is_not_the_process_is_watched_whatever_its_values(run: list[Encoded]) -> None:
    """With temperatures in degC under the signal names of the reactor, the identified model judges."""
    celsius = [
        with_value(m, Sample.FromString(m.payload).value - 400.0) if at % 3 == 2 else m for at, m in enumerate(run)
    ]
    monitor = Monitor(CONFIG, 0, points=False)
    alarms = fed(monitor, celsius)
    assert monitor.phase == "watching"
    assert monitor.pipeline.reference in ("arx", "black-box")
    assert not [item.alarm for item in alarms if item.alarm.startswith("range/")]


@pytest.mark.parametrize("signal", SIGNALS)
def test_a_value_at_a_bound_is_a_measurement(signal: str) -> None:
    """A sensor of a plant at its bound may show a twentieth of the range more."""
    (item,) = signal_ranges(cstr(), (signal,))
    variable = {v.name: v for v in (*cstr().states, *cstr().inputs)}[signal]
    span = variable.upper - variable.lower
    assert item.lower == pytest.approx(variable.lower - 0.05 * span)
    assert item.upper == pytest.approx(variable.upper + 0.05 * span)
    assert item.unit == variable.unit


def test_without_a_model_and_for_an_output_that_is_no_state_no_range_is_known() -> None:
    """A biased thermometer shows the temperature plus a number, so the bounds of the temperature are not its own."""
    assert signal_ranges(None, SIGNALS) == [ANY] * 3
    biased = effect_of("temperature_bias").extend(cstr())
    assert [item.is_bounded for item in signal_ranges(biased, SIGNALS)] == [True, True, False]
    assert [item.is_bounded for item in signal_ranges(tanks(), ("u", "x2", "elsewhere"))] == [True, True, False]
    assert isinstance(biased.outputs[1].expression, ca.SX)


def test_a_plant_that_is_judged_by_a_linear_model_alone_has_no_such_alarm() -> None:
    monitor = Monitor(MonitorConfig(reference="arx"), 0)
    assert not [alarm.alarm for alarm in monitor.alarms.all_alarms() if alarm.alarm.startswith("range/")]
    assert {alarm.alarm for alarm in Monitor(CONFIG, 0).alarms.all_alarms() if alarm.alarm.startswith("range/")} == {
        "range/qc",
        "range/C",
        "range/T",
    }
