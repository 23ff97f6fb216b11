"""Sessions of a monitor in a recording, by its reports of health, its alarms and its baselines."""

import pytest

from monitor_node.config import MonitorConfig
from monitor_node.replay.verification import Session, find_sessions, is_timeout, verify
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, Baseline, Health
from reactorwatch.errors import InputError

HEARD = {"T": 1_000, "C": 2_000}
OTHER = {"T": 9_000}


def health(
    start_s: float, after_s: float, phase: str = "monitoring", heard: dict[str, int] | None = None, lost: int = 0
) -> Encoded:
    """Report of a monitor some time after its start."""
    message = Health(
        time_ns=round((start_s + after_s) * 1e9), uptime_s=after_s, phase=phase, heard_from_ns=heard or {}, lost=lost
    )
    return encode(Publication(keys.key("cstr", keys.HEALTH, "monitor"), message))


def alarm(name: str, event: str, time_ns: int = 1) -> Encoded:
    return encode(Publication(keys.key("cstr", keys.ALARM, name), Alarm(alarm=name, event=event, time_ns=time_ns)))


def baseline(number: int) -> Encoded:
    return encode(Publication(keys.key("cstr", keys.BASELINE, "monitor"), Baseline(time_ns=number)))


def spans(sessions: list[Session]) -> list[tuple[int, int | None]]:
    return [(session.first, session.end) for session in sessions]


def test_reports_of_one_start_are_one_session_with_the_newest_counts() -> None:
    messages = [
        health(5.0, 0.0, "waiting"),
        health(5.004, 10.0, heard={"T": 1_000}),
        health(4.996, 20.0, heard=HEARD, lost=3),
    ]
    (session,) = find_sessions(messages, "cstr")
    assert (session.starts_s, session.first, session.end, session.fresh) == ([5.0], 0, None, True)
    assert (session.heard_from_ns, session.lost) == (HEARD, 3)


def test_a_monitor_that_starts_without_a_state_starts_a_session() -> None:
    messages = [
        alarm("shewhart/T", "acknowledge"),
        health(0.0, 10.0, heard=HEARD),
        health(0.0, 20.0, heard=HEARD),
        health(30.0, 0.0, "waiting"),
        alarm("shewhart/C", "acknowledge"),
        health(30.0, 10.0, heard=OTHER),
    ]
    first, second = find_sessions(messages, "cstr")
    assert spans([first, second]) == [(0, 3), (3, None)]
    assert (first.fresh, second.fresh) == (False, True)
    assert (first.heard_from_ns, second.heard_from_ns) == (HEARD, OTHER)
    assert [item.alarm for item in first.events] == ["shewhart/T"], "that of before the first report is of its session"
    assert [item.alarm for item in second.events] == ["shewhart/C"]


def test_a_start_a_hundredth_of_a_second_away_is_the_same() -> None:
    assert len(find_sessions([health(0.0, 10.0, heard=HEARD), health(0.009, 20.0, "waiting")], "cstr")) == 1
    assert len(find_sessions([health(0.0, 10.0, heard=HEARD), health(0.02, 20.0, "waiting")], "cstr")) == 2


@pytest.mark.parametrize(
    ("before", "after", "resumes"),
    [
        (health(0.0, 10.0, heard=HEARD), health(30.0, 1.0, heard=HEARD), True),
        (health(0.0, 10.0, heard=HEARD), health(30.0, 1.0, "waiting", heard=HEARD), False),
        (health(0.0, 10.0, heard=HEARD), health(30.0, 1.0, heard=OTHER), False),
        (health(0.0, 0.0, "waiting"), health(30.0, 1.0, heard=HEARD), True),  # too short for a second report
        (health(0.0, 10.0), health(30.0, 1.0, heard=HEARD), False),
    ],
)
def test_a_monitor_that_resumed_continues_its_session(before: Encoded, after: Encoded, *, resumes: bool) -> None:
    sessions = find_sessions([before, after], "cstr")
    assert spans(sessions) == ([(0, None)] if resumes else [(0, 1), (1, None)])
    assert sessions[0].starts_s == ([0.0, 30.0] if resumes else [0.0])


def test_reports_of_two_monitors_at_the_same_time_are_refused() -> None:
    messages = [health(0.0, 10.0, heard=HEARD), health(5.0, 6.0, heard=OTHER), health(0.0, 20.0, heard=HEARD)]
    with pytest.raises(InputError, match="two monitors of the plant at the same time"):
        find_sessions(messages, "cstr")
    assert len(find_sessions(messages[:2], "cstr")) == 2


def test_a_monitor_that_waits_for_another_is_no_session_and_without_any_there_is_nothing_to_verify() -> None:
    blocked = health(3.0, 1.0, keys.BLOCKED)
    assert spans(find_sessions([blocked, health(0.0, 10.0, heard=HEARD), blocked], "cstr")) == [(0, None)]
    damaged = health(0.0, 10.0)._replace(payload=b"\xff\xff")
    for messages in ([], [blocked], [damaged], [alarm("shewhart/T", "acknowledge")]):
        with pytest.raises(InputError, match="holds no report of health of a monitor of plant 'cstr'"):
            find_sessions(messages, "cstr")
    with pytest.raises(InputError, match="of plant 'tanks'"):
        find_sessions([health(0.0, 1.0)], "tanks")


def test_actions_and_timeouts_are_the_events_of_a_session_and_what_follows_from_samples_is_not() -> None:
    events = ["raised", "cleared", "shelf time over", "acknowledge", "shelve", "unshelve", "suppress", "comment"]
    messages = [health(0.0, 1.0), *(alarm("shewhart/T", event) for event in events)]
    messages += [alarm("silence/plant", "raised"), alarm("silence/plant", "cleared"), alarm("silence/T", "raised")]
    messages += [alarm("recording/disk", "acknowledge")]
    (session,) = find_sessions(messages, "cstr")
    assert [(item.alarm, item.event) for item in session.events] == [
        *(("shewhart/T", event) for event in events[3:]),
        ("silence/plant", "raised"),
    ]
    assert [is_timeout(item) for item in session.events] == [False] * 5 + [True]


def test_a_baseline_that_is_published_again_is_one_change_and_those_before_the_first_report_come_first() -> None:
    messages = [
        baseline(1), baseline(2), baseline(1), health(0.0, 1.0, heard=HEARD), baseline(2), baseline(3),
        health(9.0, 0.0, "waiting"), baseline(4), baseline(4),
    ]  # fmt: skip
    first, second = find_sessions(messages, "cstr")
    assert [item.time_ns for item in first.baselines] == [1, 2, 3]
    assert [item.time_ns for item in second.baselines] == [4]


@pytest.mark.parametrize(
    ("messages", "text"),
    [
        ([health(0.0, 10.0)], "its earlier input is not in it; verify the folder of all its files"),
        ([health(0.0, 10.0, heard={"T": 1_000})], "the first samples of T that it received are not in it"),
        ([health(0.0, 0.0, "waiting")], "holds no message of a monitor on its samples"),
    ],
)
def test_a_recording_that_lacks_the_start_of_a_session_cannot_be_verified(messages: list[Encoded], text: str) -> None:
    with pytest.raises(InputError, match=text):
        verify(lambda: messages, MonitorConfig(diagnose_training=False))
