"""The alarms of a plant: no chatter, one incident a fault, out of sight but followed, and what a restart keeps."""

import msgspec
import numpy as np
import pytest

from monitor_node.alarms.alarms import SuspectedCause
from monitor_node.alarms.annunciator import AnnunciatorMemory
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.alarm_states import Event, State
from reactorwatch.contract.codec import encode
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Incident, Priority
from reactorwatch.errors import InputError
from reactorwatch.records.record import to_time_ns
from reactorwatch.spc.charts.base import Judgement
from recorder.tools.player import samples_of

from .desk import AT_ONCE, Desk

IN, OUT = 0.0, 5.0


# --- delays and dead band ------------------------------------------------------------------------------------


def test_a_value_that_trembles_at_its_limit_is_one_alarm_with_delays_and_dead_band_and_many_without() -> None:
    trembling = 3.0 + 0.2 * np.where(np.arange(200) % 4 < 2, 1, -1)  # between 2.8 and 3.2, the limit is 3
    bare = Desk(msgspec.structs.replace(AT_ONCE, dead_band=0.0))
    banded = Desk(AT_ONCE)  # back in is below 2.7
    for row, value in enumerate(trembling):
        bare.point(row / 10, T=float(value))
        banded.point(row / 10, T=float(value))
    assert bare.changes().count(("shewhart/T", "raised")) == 50
    assert banded.changes() == [("shewhart/T", "raised")]


def test_without_dead_band_the_off_delay_alone_rides_over_short_returns() -> None:
    desk = Desk(msgspec.structs.replace(AT_ONCE, dead_band=0.0, clear_count=3))
    for row, letter in enumerate("x..x..x...x"):
        desk.point(row, T=OUT if letter == "x" else IN)
    assert [alarm.time_ns // to_time_ns(1.0) for alarm in desk.messages(Alarm)] == [0, 9, 10]


@pytest.mark.parametrize("sign", [1, -1])
def test_back_in_is_a_tenth_within_the_limit_that_was_crossed(sign: int) -> None:
    desk = Desk(AT_ONCE)
    for minute, value in enumerate((3.1, 2.71)):
        desk.point(minute, T=sign * value)
    assert desk.alarm().memory.state is State.UNACKNOWLEDGED
    desk.point(2, T=sign * 2.69)
    assert desk.alarm().memory.state is State.RETURNED_UNACKNOWLEDGED


@pytest.mark.parametrize("sign", [1, -1])
def test_the_dead_band_is_measured_from_the_centre_of_the_chart(sign: int) -> None:
    desk = Desk()
    active = []
    for minute, deviation in enumerate((3.1, 2.71, 2.69)):
        judgement = Judgement(440.0 + sign * deviation, 440.0, 437.0, 443.0, deviation > 3.0)
        desk.judge(desk.alarm(), minute, judgement)
        active.append(desk.alarm().memory.is_active)
    assert active == [True, True, False]


# --- incidents -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_leak_of_the_demonstration_is_one_incident_of_several_alarms(seed: int) -> None:
    """A leak of 15 %, which charts of both outputs feel; one alarm is the first."""
    plant = PlantConfig(seed=seed, faults=("coolant_flow:step:-0.15@150min",))
    messages = (encode(item) for item in samples_of(simulate_record(plant, 2400), "cstr"))
    alarms = backtest.run(messages, MonitorConfig(diagnose_training=False)).alarm_messages
    raised = [alarm for alarm in alarms if alarm.event == "raised"]
    assert {"shewhart/C", "shewhart/T", "ewma/T", "mewma/all"} <= {alarm.alarm for alarm in raised}
    assert {alarm.incident for alarm in alarms} == {1}
    assert {alarm.alarm for alarm in alarms if alarm.first_in} == {raised[0].alarm}


def test_an_alarm_long_after_the_last_change_is_an_incident_of_its_own() -> None:
    desk = Desk(msgspec.structs.replace(AT_ONCE, incident_min=30.0))
    for minute, values in (
        (0, {"T": OUT}),  # incident 1, and T stands on
        (20, {"C": OUT}),  # within 30 min of the raise of T
        (45, {"C": IN}),  # clears C
        (75, {"C": OUT}),  # within 30 min of that
        (106, {"C": IN}),
        (137, {"C": OUT}),  # 31 min after it, though T stands
    ):
        desk.point(minute, **values)
    told = [
        (alarm.alarm[-1], alarm.incident, alarm.first_in) for alarm in desk.messages(Alarm) if alarm.event == "raised"
    ]
    assert told == [("T", 1, True), ("C", 1, False), ("C", 1, False), ("C", 2, True)]


@pytest.mark.parametrize("spike_min", [10.0, 50.0, 300.0])
def test_a_spike_takes_no_suspects_away_from_the_incident_that_stands(spike_min: float) -> None:
    """An alarm that follows it is of the incident that it would be of without the spike, with its suspects."""
    desk = Desk(msgspec.structs.replace(AT_ONCE, incident_min=60.0))
    spike = desk.board.declare("spike", "T", without_on_delay=True, names_cause=True, is_transient=True)
    desk.point(0.0, T=OUT)
    desk.board.set_suspects([SuspectedCause("coolant_flow", 0.9)])
    for minute, out in ((spike_min, True), (spike_min + 0.1, False)):
        judgement = Judgement(9.0 if out else 0.0, 0.0, -6.0, 6.0, out)
        desk.judge(spike, minute, judgement)
    desk.board.set_suspects([SuspectedCause("coolant_flow", 0.95)])
    assert [item.probability for item in desk.board.alarm("shewhart/T").suspects] == [0.95]
    assert desk.board.alarm("spike/T").incident == desk.board.incident == 1
    assert not desk.board.alarm("spike/T").first_in
    desk.point(59.0 if spike_min < 59.0 else spike_min + 5.0, C=OUT)
    follower = desk.board.alarm("shewhart/C")
    assert follower.incident == (1 if spike_min < 59.0 else 2)
    assert [item.cause for item in follower.suspects] == (["coolant_flow"] if spike_min < 59.0 else [])


def test_a_spike_alone_is_an_incident() -> None:
    desk = Desk()
    spike = desk.board.declare("spike", "T", without_on_delay=True, names_cause=True, is_transient=True)
    desk.judge(spike, 1.0, Judgement(9.0, 0.0, -6.0, 6.0, True))
    assert (desk.board.incident, desk.board.alarm("spike/T").first_in) == (1, True)


def test_a_clock_that_is_set_back_begins_a_new_incident() -> None:
    desk = Desk()
    desk.point(100, T=OUT)
    desk.point(10, C=OUT)
    assert [alarm.incident for alarm in desk.messages(Alarm)] == [1, 2]


def test_an_incident_is_published_with_each_change_of_it_and_only_then() -> None:
    desk = Desk()
    desk.point(0.5, T=OUT)
    desk.point(1.0, T=OUT)  # nothing changes
    desk.board.set_suspects([SuspectedCause("coolant_flow", 0.9)])
    desk.point(2.0, C=OUT)  # suspects and a second alarm: one message
    desk.board.set_suspects([SuspectedCause("coolant_flow", 0.9)])
    desk.point(3.0, C=OUT)  # the same suspects again
    desk.published += desk.board.act("shewhart/T", Event.ACKNOWLEDGE, "Anna", "")  # C is unacknowledged still
    desk.published += desk.board.act("shewhart/C", Event.ACKNOWLEDGE, "Anna", "")
    desk.point(4.0, T=IN)
    desk.point(5.0, C=IN)
    published = [
        (item.time_ns, list(item.alarms), [s.cause for s in item.suspects], item.state, item.until_ns)
        for item in desk.messages(Incident)
    ]
    first, both = ["shewhart/T"], ["shewhart/T", "shewhart/C"]
    assert published == [
        (to_time_ns(0.5), first, [], AlarmState.ALARM_STATE_UNACKNOWLEDGED, 0),
        (to_time_ns(2.0), both, ["coolant_flow"], AlarmState.ALARM_STATE_UNACKNOWLEDGED, 0),
        (to_time_ns(3.0), both, ["coolant_flow"], AlarmState.ALARM_STATE_ACKNOWLEDGED, 0),
        (to_time_ns(5.0), both, ["coolant_flow"], AlarmState.ALARM_STATE_NORMAL, to_time_ns(5.0)),
    ]
    assert {(item.number, item.since_ns) for item in desk.messages(Incident)} == {(1, to_time_ns(0.5))}
    keys = {item.key for item in desk.published if isinstance(item.message, Incident)}
    assert keys == {"reactor/cstr/incident/1"}


def test_the_suspects_of_an_alarm_are_those_of_its_incident_at_its_own_changes() -> None:
    desk = Desk()
    desk.point(0.5, T=OUT)
    desk.board.set_suspects([SuspectedCause("coolant_flow", 0.9)])
    desk.point(1.0, C=OUT)
    desk.board.set_suspects([SuspectedCause("feed_flow", 0.7)])
    desk.point(2.0, T=IN)
    desk.point(3.0, C=OUT)
    published = [(item.alarm, item.event, [s.cause for s in item.suspects]) for item in desk.messages(Alarm)]
    assert published == [
        ("shewhart/T", "raised", []),
        ("shewhart/C", "raised", ["coolant_flow"]),
        ("shewhart/T", "cleared", ["feed_flow"]),
    ]
    assert [s.cause for s in desk.board.alarm("shewhart/C").suspects] == ["feed_flow"], "a list has the newest"


def test_an_incident_that_a_later_one_follows_keeps_its_suspects_and_is_published_until_it_is_over() -> None:
    desk = Desk(msgspec.structs.replace(AT_ONCE, incident_min=30.0))
    desk.point(1.0, T=OUT)
    desk.board.set_suspects([SuspectedCause("coolant_flow", 0.9)])
    desk.point(2.0, T=OUT)
    desk.point(60.0, T=OUT, C=OUT)
    desk.board.set_suspects([SuspectedCause("feed_flow", 0.7)])
    desk.point(61.0, T=IN)
    desk.published += desk.board.act("shewhart/T", Event.ACKNOWLEDGE, "Anna", "")
    newest = {item.number: item for item in desk.messages(Incident)}
    assert [s.cause for s in newest[1].suspects] == ["coolant_flow"]
    assert [s.cause for s in newest[2].suspects] == ["feed_flow"]
    assert (newest[1].until_ns, newest[1].state) == (to_time_ns(61.0), AlarmState.ALARM_STATE_NORMAL)
    assert (newest[2].until_ns, newest[2].state) == (0, AlarmState.ALARM_STATE_UNACKNOWLEDGED)
    assert [s.cause for s in desk.board.alarm("shewhart/T").suspects] == ["coolant_flow"]
    assert [item.number for item in desk.board.memory.incidents] == [2], "one that is over is forgotten"


# --- out of sight --------------------------------------------------------------------------------------------


def test_a_shelf_ends_with_its_time_and_a_standing_alarm_comes_up_again() -> None:
    desk = Desk()
    desk.point(0, T=OUT)
    (change, *_) = desk.board.act("shewhart/T", Event.SHELVE, "Anna", "known", 10.0)
    assert isinstance(change.message, Alarm)
    assert change.message.shelved_until_ns == to_time_ns(10.0)
    desk.point(9.9, T=OUT)
    assert desk.alarm().memory.state is State.SHELVED
    desk.point(10.0, T=OUT)
    last = desk.messages(Alarm)[-1]
    assert (last.event, last.state) == ("shelf time over", AlarmState.ALARM_STATE_UNACKNOWLEDGED)
    assert (last.incident, last.by, last.comment, last.shelved_until_ns) == (1, "Anna", "known", 0)


def test_changes_of_a_suppressed_alarm_are_published_and_count_when_it_returns() -> None:
    desk = Desk()
    desk.point(0, T=IN)
    desk.board.act("shewhart/T", Event.SUPPRESS, "Anna", "start-up")
    desk.point(1, T=OUT)
    hidden = desk.messages(Alarm)[-1]
    assert (hidden.event, hidden.state, hidden.incident) == ("raised", AlarmState.ALARM_STATE_SUPPRESSED_BY_DESIGN, 0)
    assert hidden.comment == "start-up"
    assert desk.figures().alarms_10min == 0
    desk.published += desk.board.act("shewhart/T", Event.UNSUPPRESS, "Anna", "")
    shown = desk.messages(Alarm)[-1]
    assert (shown.state, shown.incident, shown.first_in) == (AlarmState.ALARM_STATE_UNACKNOWLEDGED, 1, True)
    assert (shown.time_ns, shown.raised_ns) == (to_time_ns(1.0), to_time_ns(1.0))
    assert desk.figures().alarms_10min == 1


def test_a_clock_that_is_set_back_ends_a_shelf() -> None:
    desk = Desk()
    desk.point(100, T=OUT)
    desk.board.act("shewhart/T", Event.SHELVE, "Anna", "", 60.0)
    desk.point(50, T=OUT)
    assert desk.alarm().memory.state is State.UNACKNOWLEDGED


def test_a_new_occurrence_carries_no_name_from_the_last_one() -> None:
    desk = Desk()
    desk.point(0, T=OUT)
    desk.board.act("shewhart/T", Event.ACKNOWLEDGE, "Anna", "seen")
    desk.point(1, T=IN)
    assert (desk.messages(Alarm)[-1].state, desk.messages(Alarm)[-1].by) == (AlarmState.ALARM_STATE_NORMAL, "Anna")
    desk.point(2, T=OUT)
    assert (desk.messages(Alarm)[-1].by, desk.messages(Alarm)[-1].comment) == ("", "")


# --- over a restart ------------------------------------------------------------------------------------------


def busy_desk() -> Desk:
    """T acknowledged and standing, C shelved until minute 31, one incident."""
    desk = Desk()
    desk.point(0, T=OUT)
    desk.point(1, C=OUT)
    desk.board.act("shewhart/T", Event.ACKNOWLEDGE, "Anna", "seen")
    desk.board.act("shewhart/C", Event.SHELVE, "Ben", "", 30.0)
    return desk


def stored(desk: Desk) -> AnnunciatorMemory:
    """The memory of a board, as it is read back."""
    return AnnunciatorMemory.from_bytes(desk.board.memory.to_bytes())


def test_a_change_that_an_error_kept_from_being_applied_is_found_again() -> None:
    desk, out = Desk(), Judgement(OUT, 0.0, -3.0, 3.0, True)
    assert desk.alarm().update(out) is not None
    again = desk.board.declare("shewhart", "T")  # as the pipeline does that is made after the error
    change = again.update(out)
    assert change is not None
    desk.published += desk.board.apply(to_time_ns(1.0), [change])
    assert desk.changes() == [("shewhart/T", "raised")]
    assert desk.board.declare("shewhart", "T").update(out) is None, "one that is active is not raised again"


def test_a_stored_annunciator_resumes_as_if_it_had_never_stopped() -> None:
    stayed, gone = busy_desk(), busy_desk()
    back = Desk()
    back.board.restore(stored(gone))
    stayed.published.clear()
    rows: list[tuple[float, dict[str, float]]] = [
        (2, {"T": OUT, "C": OUT}),
        (30.9, {"T": IN}),
        (31, {"C": OUT}),
        (32, {"T": OUT, "C": IN}),
    ]
    for minute, values in rows:
        stayed.point(minute, **values)
        back.point(minute, **values)
    assert back.changes() == [
        ("shewhart/T", "cleared"),
        ("shewhart/C", "shelf time over"),
        ("shewhart/T", "raised"),
        ("shewhart/C", "cleared"),
    ]
    assert [encode(item) for item in stayed.published if isinstance(item.message, Alarm)] == [
        encode(item) for item in back.published if isinstance(item.message, Alarm)
    ]
    assert encode(stayed.published[-1]) == encode(back.published[-1])
    assert stayed.board.memory.to_bytes() == back.board.memory.to_bytes()


def test_an_alarm_that_there_is_no_more_is_left_out() -> None:
    desk = Desk(signals=("T",))
    desk.board.restore(stored(busy_desk()))
    assert [alarm.alarm for alarm in desk.board.all_alarms()] == ["shewhart/T"]
    assert desk.alarm().memory.state is State.ACKNOWLEDGED


def test_a_state_that_cannot_be_is_refused_and_changes_nothing() -> None:
    memory, desk = stored(busy_desk()), Desk()
    memory.alarms["shewhart/T"].state = State.NORMAL
    before = desk.board.memory.to_bytes()
    with pytest.raises(InputError, match="shewhart/T is normal, but its condition is active"):
        desk.board.restore(memory)
    assert desk.board.memory.to_bytes() == before


# --- messages, and rest --------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1, -1])
def test_the_message_of_an_alarm_states_the_value_and_the_limit_that_was_crossed(sign: int) -> None:
    desk = Desk()
    desk.point(1.0, T=sign * 5.0)
    desk.point(2.0, T=sign * 1.0)
    raised, cleared = desk.messages(Alarm)
    assert (raised.value, raised.limit, raised.unit) == (sign * 5.0, sign * 3.0, "K")
    assert (raised.text, raised.raised_ns, raised.cleared_ns) == ("shewhart/T is out", to_time_ns(1.0), 0)
    assert (cleared.value, cleared.limit, cleared.unit) == (sign * 1.0, sign * 3.0, "K")
    assert cleared.text == "shewhart/T is back within its limits"
    assert (cleared.raised_ns, cleared.cleared_ns) == (to_time_ns(1.0), to_time_ns(2.0))


def test_the_text_of_a_raised_alarm_names_the_operation_and_the_warning() -> None:
    desk = Desk()
    desk.board.describe_operation = lambda time_ns: f"in operation since {time_ns} ns"
    desk.board.warning = "false alarms are likely"
    desk.point(1.0, T=OUT)
    assert desk.messages(Alarm)[-1].text == (
        f"shewhart/T is out; in operation since {to_time_ns(1.0)} ns; false alarms are likely"
    )


def test_a_change_at_a_time_of_its_own_is_published_with_that_time() -> None:
    desk, out = Desk(), Judgement(OUT, 0.0, -3.0, 3.0, True)
    change = desk.alarm().update(out, "K", to_time_ns(0.5))
    assert change is not None
    desk.published += desk.board.apply(to_time_ns(2.0), [change])
    (raised,) = desk.messages(Alarm)
    assert (raised.time_ns, raised.raised_ns) == (to_time_ns(0.5), to_time_ns(0.5))


def test_causes_that_a_chart_finds_are_those_of_the_incident() -> None:
    desk, out = Desk(), Judgement(OUT, 0.0, -3.0, 3.0, True)
    change = desk.alarm().update(out)
    assert change is not None
    change.entries = [SuspectedCause("coolant_flow", 0.9)]
    desk.published += desk.board.apply(to_time_ns(1.0), [change])
    desk.point(1.0)
    (incident,) = desk.messages(Incident)
    assert [item.cause for item in incident.suspects] == ["coolant_flow"]


def test_suspects_alone_change_an_incident_and_a_search_that_stopped_is_stated_until_the_next() -> None:
    desk = Desk()
    desk.board.set_suspects([SuspectedCause("coolant_flow", 0.9)])  # there is no incident yet
    desk.point(1.0, T=OUT)
    desk.board.set_suspects([], stopped=True)
    desk.point(2.0, T=OUT)
    desk.board.set_suspects([SuspectedCause("coolant_flow", 0.9)])
    desk.point(3.0, T=OUT)
    published = [(item.time_ns, [s.cause for s in item.suspects], item.text) for item in desk.messages(Incident)]
    assert published == [
        (to_time_ns(1.0), [], ""),
        (to_time_ns(2.0), [], "the search for its cause stopped at its budget of filter steps, so none is named"),
        (to_time_ns(3.0), ["coolant_flow"], ""),
    ]


def test_an_alarm_raised_while_suppressed_is_first_out_of_no_incident() -> None:
    """It was that of the incident before."""
    desk = Desk()
    desk.point(0, T=OUT)
    assert desk.messages(Alarm)[-1].first_in
    desk.board.act("shewhart/T", Event.ACKNOWLEDGE, "Anna", "")
    desk.point(1, T=IN)
    desk.board.act("shewhart/T", Event.SUPPRESS, "Anna", "start-up")
    desk.point(2, T=OUT)
    hidden = desk.messages(Alarm)[-1]
    assert (hidden.event, hidden.incident, hidden.first_in) == ("raised", 0, False)


def test_an_alarm_that_is_declared_again_counts_its_points_from_the_start() -> None:
    desk = Desk(msgspec.structs.replace(AT_ONCE, raise_count=2, window=3, clear_count=3))
    desk.point(0, T=OUT)
    desk.alarms["T"] = desk.board.declare("shewhart", "T")
    desk.point(1, T=OUT)
    assert desk.changes() == []
    desk.point(2, T=OUT)
    assert desk.changes() == [("shewhart/T", "raised")]
    for minute in (3, 4):
        desk.point(minute, T=IN)
    desk.alarms["T"] = desk.board.declare("shewhart", "T")
    for minute in (5, 6):
        desk.point(minute, T=IN)
        assert desk.alarm().memory.is_active
    desk.point(7, T=IN)
    assert not desk.alarm().memory.is_active


def test_a_board_is_at_rest_while_no_alarm_is_active_or_shelved_or_remembers_points() -> None:
    desk = Desk(msgspec.structs.replace(AT_ONCE, raise_count=2, window=2))
    c, t = desk.alarms["C"], desk.alarms["T"]
    assert desk.board.is_at_rest([])
    desk.point(0, T=OUT)
    assert [desk.board.is_at_rest(counting) for counting in ([], [c], [t], [c, t])] == [False, False, True, True]
    desk.point(1, T=OUT)
    assert not desk.board.is_at_rest([c, t])
    desk.point(2, T=IN)
    desk.point(3, C=IN)
    assert desk.board.is_at_rest([])
    desk.board.act("shewhart/C", Event.SHELVE, "Anna", "", 10.0)
    assert not desk.board.is_at_rest([c, t])
    desk.point(13, T=IN)
    assert desk.board.is_at_rest([])


def test_an_alarm_that_names_its_cause_leaves_nothing_unexplained() -> None:
    desk = Desk()
    stuck = desk.board.declare("stuck", "T", without_on_delay=True, names_cause=True)
    desk.judge(stuck, 1.0, Judgement(9.0, 0.0, -6.0, 6.0, True))
    unexplained = [desk.board.has_unexplained]
    for minute, value in ((2.0, OUT), (3.0, IN)):
        desk.point(minute, C=value)
        unexplained.append(desk.board.has_unexplained)
    assert unexplained == [False, True, False]
    assert [alarm.names_cause for alarm in desk.messages(Alarm)] == [True, False, False]


def test_delays_are_left_out_one_by_one_and_priority_and_dead_band_may_be_given() -> None:
    desk = Desk(msgspec.structs.replace(AT_ONCE, raise_count=2, window=2, clear_count=2))
    raised_at_once = desk.board.declare("silence", "T", without_on_delay=True)
    cleared_at_once = desk.board.declare("shift", "T", without_off_delay=True)
    wide = desk.board.declare("range", "T", without_on_delay=True, without_off_delay=True, dead_band=0.5)
    urgent = desk.board.declare("stuck", "C", priority="critical")
    assert (raised_at_once.priority, cleared_at_once.priority) == (Priority.PRIORITY_HIGH, Priority.PRIORITY_HIGH)
    assert urgent.priority == Priority.PRIORITY_CRITICAL
    points = {value: Judgement(value, 0.0, -3.0, 3.0, value > 3.0) for value in (5.0, 2.0, 1.0)}
    for alarm, expected in (
        (raised_at_once, [True, True, True, False]),
        (cleared_at_once, [False, True, False, False]),
        (wide, [True, True, True, False]),
    ):
        active = []
        for minute, value in enumerate((5.0, 5.0, 2.0, 1.0)):
            desk.judge(alarm, minute, points[value])
            active.append(alarm.memory.is_active)
        assert active == expected


def test_a_reason_stays_until_another_is_given() -> None:
    desk = Desk()
    desk.point(0, T=OUT)
    desk.board.act("shewhart/T", Event.SHELVE, "Anna", "known", 10.0)
    desk.board.act("shewhart/T", Event.UNSHELVE, "Ben", "")
    assert (desk.alarm().memory.by, desk.alarm().memory.comment) == ("Ben", "known")
    desk.board.act("shewhart/T", Event.ACKNOWLEDGE, "Ben", "seen")
    assert desk.alarm().memory.comment == "seen"


@pytest.mark.parametrize("minutes", [30.0, 480.0])
def test_shelving_again_changes_its_end_and_the_longest_time_is_allowed(minutes: float) -> None:
    desk = Desk()
    desk.point(5.0, T=OUT)
    desk.board.act("shewhart/T", Event.SHELVE, "Anna", "", 10.0)
    desk.point(8.0, T=OUT)
    desk.board.act("shewhart/T", Event.SHELVE, "Anna", "", minutes)
    memory = desk.alarm().memory
    assert (memory.shelved_ns, memory.shelved_until_ns) == (to_time_ns(8.0), to_time_ns(8.0 + minutes))
    desk.point(7.9 + minutes, T=OUT)
    assert desk.alarm().memory.state is State.SHELVED
    desk.point(8.0 + minutes, T=OUT)
    assert desk.alarm().memory.state is State.UNACKNOWLEDGED


def test_an_alarm_that_names_its_cause_keeps_it_whatever_the_incident_is_suspected_of() -> None:
    desk = Desk()
    stuck = desk.board.declare("stuck", "T", without_on_delay=True, names_cause=True)
    change = stuck.update(Judgement(9.0, 0.0, -6.0, 6.0, True))
    assert change is not None
    change.suspects, change.contributions = [SuspectedCause("stuck_sensor", 1.0)], {"T": 1.0}
    desk.published += desk.board.apply(to_time_ns(1.0), [change])
    desk.board.set_suspects([SuspectedCause("coolant_flow", 0.9)])
    desk.point(2.0, C=OUT)
    message = desk.board.alarm("stuck/T")
    assert [(item.cause, item.probability) for item in message.suspects] == [("stuck_sensor", 1.0)]
    assert [(item.signal, item.share) for item in message.contributions] == [("T", 1.0)]
    assert [item.cause for item in desk.board.alarm("shewhart/C").suspects] == ["coolant_flow"]


def test_before_the_first_sample_the_alarms_are_listed_at_time_0() -> None:
    assert [(alarm.alarm, alarm.time_ns) for alarm in Desk().board.all_alarms()] == [
        ("shewhart/C", 0),
        ("shewhart/T", 0),
    ]
