"""Lost rows: their inputs and the effects are unknown, so a sound plant raises no alarm."""

from math import nan
from typing import Literal, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor_node.causes.isolation import UNKNOWN, Isolation
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.ingest.alignment import Interval, MeasuredRow
from monitor_node.learn.process_reference import ProcessMemory, ProcessReference, input_reach
from reactorwatch.contract.codec import Encoded
from reactorwatch.contract.messages_pb2 import Alarm, Sample
from reactorwatch.kalman.ekf import Filter
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator

from .faulty import SENSORS, rows_of
from .samples import Rows, samples

Reference = Literal["process", "arx", "black-box"]
TRAINED, ROWS, AT = 420, 520, 450
"""Rows until the monitors of the tests are past their training, rows in all, and the row of the move."""

HOUR_NS = 3600 * 10**9


def config(reference: Reference) -> MonitorConfig:
    return MonitorConfig(training_min=40.0, isolation=False, reference=reference)


def sound(qc: Rows, seed: int) -> list[Encoded]:
    """What a sound plant with this input publishes."""
    generator = np.random.default_rng(seed)
    time_min = np.arange(qc.size) / 10
    outputs = Simulator(cstr()).run(time_min, qc, np.array([0.1, 438.54])).outputs
    outputs = outputs + generator.normal(size=outputs.shape) * (0.002, 0.3)
    return list(samples(time_min, {"qc": qc, "C": outputs[:, 0], "T": outputs[:, 1]}))


def steps(seed: int = 8) -> Rows:
    """An input that is held for ten rows."""
    return np.repeat(np.random.default_rng(seed).uniform(90, 111, ROWS // 10), 10)


def restless(seed: int = 8) -> Rows:
    """An input that is another in each row, as that of a controller."""
    return np.asarray(103.0 + np.random.default_rng(seed).normal(size=ROWS) * 3.0)


INPUTS = {"held": steps(), "restless": restless()}


@pytest.fixture(scope="module")
def trained() -> dict[tuple[str, str], bytes]:
    """Monitors after a training, by reference and input."""
    found = {}
    for name, qc in INPUTS.items():
        messages = sound(qc, seed=3)
        for reference in get_args(Reference):
            monitor = Monitor(config(reference), 0, points=False)
            for message in messages[: 3 * TRAINED]:
                monitor.on_message(message, 0)
            assert monitor.phase == "watching"
            found[reference, name] = monitor.to_bytes()
    return found


def raised(state: bytes, reference: Reference, messages: list[Encoded]) -> set[str]:
    """The alarms that a monitor raises, but for those of silence."""
    monitor = Monitor(config(reference), 0, points=False)
    monitor.from_bytes(state)
    monitor.on_history_end()
    said = [item.message for message in messages for item in monitor.on_message(message, 0)]
    said += [item.message for item in monitor.finish()]
    assert monitor.failures.by_stage == {}
    return {
        item.alarm
        for item in said
        if isinstance(item, Alarm) and item.event == "raised" and not item.alarm.startswith("silence/")
    }


def stamped(message: Encoded, by_ns: int) -> Encoded:
    sample = Sample.FromString(message.payload)
    sample.time_ns += by_ns
    return message._replace(payload=sample.SerializeToString())


LOST = st.just({0, 1, 2}) | st.sets(st.sampled_from(range(3)), min_size=1)
"""Places of the signals of a row that are lost: all, as when a row is lost, or some."""


@settings(max_examples=20, deadline=None)
@given(
    reference=st.sampled_from(get_args(Reference)),
    move=st.floats(-13.0, 8.0),
    lost=st.lists(st.tuples(st.just(AT) | st.integers(AT - 2, AT + 3), LOST), min_size=1, max_size=3),
    by_ns=st.sampled_from([0, -HOUR_NS, HOUR_NS]),
    seed=st.integers(0, 99),
)
def test_losing_or_misstamping_samples_about_any_move_raises_no_alarm(
    trained: dict[tuple[str, str], bytes],
    reference: Reference,
    move: float,
    lost: list[tuple[int, set[int]]],
    by_ns: int,
    seed: int,
) -> None:
    """Any move, any rows about it, any of their signals, by each reference; or stamped an hour early or late."""
    qc = steps()
    qc[TRAINED:AT] = 103.0
    qc[AT:] = 103.0 + move
    messages = sound(qc, seed)
    gone = {3 * row + signal for row, signals in lost for signal in signals}
    left = []
    for at, message in enumerate(messages[3 * TRAINED :], 3 * TRAINED):
        if at not in gone:
            left.append(message)
        elif by_ns:
            left.append(stamped(message, by_ns))
    state = trained[reference, "held"]
    assert raised(state, reference, left) <= raised(state, reference, messages[3 * TRAINED :])


@settings(max_examples=10, deadline=None)
@given(rows=st.sets(st.integers(TRAINED + 5, ROWS - 5), min_size=1, max_size=8), seed=st.integers(0, 99))
def test_where_the_input_moves_in_every_row_losing_any_raises_no_alarm(
    trained: dict[tuple[str, str], bytes], rows: set[int], seed: int
) -> None:
    """How far the input goes and comes back at once was learned in the training."""
    messages = sound(INPUTS["restless"], seed)
    left = [m for at, m in enumerate(messages) if at // 3 not in rows and at >= 3 * TRAINED]
    state = trained["process", "restless"]
    assert raised(state, "process", left) <= raised(state, "process", messages[3 * TRAINED :])


@pytest.mark.parametrize("missing", [(0,), (0, 1, 2)])
def test_a_leak_behind_a_lost_row_is_found(trained: dict[tuple[str, str], bytes], missing: tuple[int, ...]) -> None:
    """The input is known again, and then the predictions are as sharp as ever."""
    qc = steps()
    messages = sound(np.where(np.arange(ROWS) >= AT, 0.9 * qc, qc), seed=4)  # what flows; qc says otherwise
    shown = sound(qc, seed=4)
    messages = [shown[at] if at % 3 == 0 else message for at, message in enumerate(messages)]
    left = [m for at, m in enumerate(messages[3 * TRAINED :], 3 * TRAINED) if at not in {3 * AT + k for k in missing}]
    assert {"shewhart/T", "ewma/T"} <= raised(trained["process", "held"], "process", left)


def test_where_nothing_is_lost_no_prediction_is_any_less_certain(
    trained: dict[tuple[str, str], bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No way is taken for uncertain, at any move, nor where only a measurement is missing."""

    def refuse(*_: object) -> None:
        raise AssertionError("the input is known")

    monkeypatch.setattr(Filter, "_predict_uncertain", refuse)
    for name, qc in INPUTS.items():
        messages = sound(qc, seed=5)[3 * TRAINED :]
        raised(trained["process", name], "process", messages)
        raised(trained["process", name], "process", [m for at, m in enumerate(messages) if at % 30 not in (1, 2)])


def measured_row(
    row: int, flow: float, values: tuple[float, float] = (0.097, 439.0), *, missing: int = 0
) -> MeasuredRow:
    interval = Interval(not missing, False, missing)
    return MeasuredRow(row * 6 * 10**9, (flow,), list(values), [], interval, interval.follows, [])


def reference_with_rows(held: float = 100.0) -> ProcessReference:
    """A reference that has settled, with an input that is held."""
    reference = ProcessReference(cstr(), ("C", "T"), ProcessMemory(SENSORS))
    for row in range(50):
        reference.update(measured_row(row, held), (True, True))
    return reference


def test_while_the_input_does_not_show_nothing_is_predicted() -> None:
    """The row whose input is missing is predicted, as the input before it is known; those after it are not."""
    reference = reference_with_rows()
    rows = [reference.update(measured_row(row, nan), (False, False)) for row in range(50, 54)]
    assert [bool(np.isfinite(row.prediction).all()) for row in rows] == [True, False, False, False]
    begun = reference.update(measured_row(54, 100.0), (False, False))
    assert not np.isfinite(begun.prediction).any()
    assert np.isfinite(reference.update(measured_row(55, 100.0), (False, False)).prediction).all()


@pytest.mark.parametrize(("input_value", "wider"), [(100.0, False), (110.0, True)])
def test_behind_a_lost_row_the_prediction_is_as_uncertain_as_the_input_was(input_value: float, wider: bool) -> None:
    """If it is as it was nothing is unknown; if not, either end of what it may have been is about one deviation off."""
    ends = []
    for flow in (100.0, input_value):
        known = reference_with_rows()
        known.update(measured_row(50, flow, (nan, nan)), (False, False))
        ends.append(known.update(measured_row(51, input_value), (False, False)))
    lost = reference_with_rows().update(measured_row(51, input_value, missing=1), (False, False))
    assert (lost.sd[1] > 1.2 * ends[0].sd[1]) is wider
    middle = 0.5 * (ends[0].prediction[1] + ends[1].prediction[1])
    assert lost.prediction[1] == pytest.approx(middle, abs=1e-6)
    apart = 0.5 * abs(ends[0].prediction[1] - ends[1].prediction[1])
    assert lost.sd[1] ** 2 == pytest.approx(ends[0].sd[1] ** 2 + apart**2, rel=0.01)


def test_the_reach_of_an_input_is_how_far_it_went_and_came_back_at_once() -> None:
    time_min = np.arange(8) / 10
    assert input_reach(time_min, np.array([1.0, 1, 1, 5, 5, 5, 5, 5])) == 0.0
    assert input_reach(time_min, np.array([1.0, 1, 4, 2, 2, nan, 9, 9])) == 2.0
    gap = np.append(time_min[:3], time_min[3:] + 0.1)
    assert input_reach(gap, np.array([1.0, 1, 4, 2, 2, 2, 2, 2])) == 0.0
    assert input_reach(time_min[:1], np.ones(1)) == 0.0


@pytest.mark.parametrize("fault", ["", "coolant_flow:step:-0.05"])
def test_no_cause_is_found_in_what_lost_rows_leave(fault: str) -> None:
    """Every third move of the input is lost; the suspects are those of the whole record."""
    rows = rows_of(*([fault] if fault else []), seed=4, after_min=10.0)
    moves = [place for place in range(40, len(rows)) if rows[place][1] != rows[place - 1][1]][::3]
    isolation = Isolation(cstr(), SENSORS)
    likeliest = isolation.suspects([row for place, row in enumerate(rows) if place not in moves])[0]
    assert likeliest.cause == (fault.split(":")[0] or UNKNOWN)
    assert not isolation.stopped
