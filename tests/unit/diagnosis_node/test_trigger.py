"""The time and the samples of a diagnosis after an alarm."""

import pytest

from diagnosis_node.trigger import TIMEOUT_NS, DiagnosisConfig, DiagnosisTrigger
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Sample
from reactorwatch.records.record import MINUTE_NS
from recorder import RecordedMessage

CONFIG = DiagnosisConfig(window_min=50.0, after_min=10.0, apart_min=30.0, out="reports")


class Live:
    """A plant that is sampled once a minute, and the diagnoses that are requested."""

    def __init__(self, config: DiagnosisConfig = CONFIG) -> None:
        self.requests: list[tuple[Alarm, list[RecordedMessage]]] = []
        self.busy = False
        self.node = DiagnosisTrigger(
            config, lambda alarm, samples: self.requests.append((alarm, samples)), lambda: self.busy
        )

    def samples(self, first_min: int, last_min: int) -> None:
        for minute in range(first_min, last_min + 1):
            self.node.on_message(_encoded("sample", "T", Sample(time_ns=minute * MINUTE_NS, value=1.0)), minute)

    def alarm(
        self, minute: int, name: str = "shewhart/T", event: str = "raised", state: AlarmState | None = None
    ) -> None:
        time_ns = minute * MINUTE_NS
        alarm = Alarm(time_ns=time_ns, raised_ns=time_ns, alarm=name, event=event, state=state)
        self.node.on_message(_encoded("alarm", name, alarm), minute)

    def spans(self) -> list[tuple[float, float]]:
        return [
            (samples[0].publish_time_ns / MINUTE_NS, samples[-1].publish_time_ns / MINUTE_NS)
            for _, samples in self.requests
        ]


def _encoded(kind: str, name: str, message: Sample | Alarm) -> Encoded:
    return encode(Publication(keys.key("cstr", kind, name), message))


def test_it_waits_until_there_is_something_to_see_and_takes_the_window() -> None:
    live = Live()
    live.samples(0, 100)
    live.alarm(100)
    live.samples(101, 109)
    assert live.requests == []
    live.samples(110, 111)
    assert live.spans() == [(60.0, 110.0)]
    ((alarm, _),) = live.requests
    assert (alarm.alarm, alarm.raised_ns) == ("shewhart/T", 100 * MINUTE_NS)


def test_what_comes_soon_after_is_the_same_trouble() -> None:
    live = Live()
    live.samples(0, 100)
    live.alarm(100)
    live.alarm(103, "ewma/C")
    live.samples(101, 120)
    live.alarm(120, "ewma/T")
    live.samples(121, 150)
    live.alarm(150, "mewma/all")
    live.samples(151, 170)
    assert [alarm.alarm for alarm, _ in live.requests] == ["shewhart/T", "mewma/all"]


def test_while_one_is_under_way_the_next_waits() -> None:
    live = Live()
    live.samples(0, 50)
    live.alarm(50)
    live.busy = True
    live.samples(51, 70)
    assert live.requests == []
    live.busy = False
    live.samples(71, 71)
    assert live.spans() == [(21.0, 71.0)]


@pytest.mark.parametrize(
    ("name", "event", "state"),
    [
        ("shewhart/T", "cleared", AlarmState.ALARM_STATE_RETURNED_UNACKNOWLEDGED),
        ("shewhart/T", "raised", AlarmState.ALARM_STATE_SHELVED),
        ("silence/plant", "raised", AlarmState.ALARM_STATE_UNACKNOWLEDGED),
    ],
)
def test_what_is_no_trouble_of_the_process_is_not_diagnosed(name: str, event: str, state: AlarmState) -> None:
    live = Live()
    live.samples(0, 50)
    live.alarm(50, name, event, state=state)
    live.samples(51, 100)
    assert live.requests == []


def test_a_plant_that_ends_is_diagnosed_by_what_there_is() -> None:
    live = Live()
    live.samples(0, 50)
    live.alarm(50)
    live.samples(51, 54)
    due_ns = live.node.next_tick_ns()
    assert due_ns == 54 + TIMEOUT_NS
    live.node.on_tick(due_ns - 1)
    assert live.requests == []
    live.node.on_tick(due_ns)
    assert live.spans() == [(4.0, 54.0)]


def test_a_plant_that_restarts_has_no_past() -> None:
    live = Live()
    live.samples(1000, 1050)
    live.alarm(1050)
    live.samples(0, 60)
    assert live.requests == []
    live.alarm(60)
    live.samples(61, 70)
    assert live.spans() == [(20.0, 70.0)]


def test_settings_that_leave_no_past_are_refused() -> None:
    with pytest.raises(ValueError, match="window_min must be more than after_min, got 30 and 30"):
        DiagnosisConfig(window_min=30.0, after_min=30.0)
