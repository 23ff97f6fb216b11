"""`status` shows what was published: rates counted by hand, active alarms, nodes, the promise."""

from google.protobuf.message import Message

from reactorwatch.cli.alarm import _alarm_line as alarm_line
from reactorwatch.cli.display import Screen
from reactorwatch.cli.status import StatusBoard
from reactorwatch.contract.codec import Encoded, encode_message
from reactorwatch.contract.messages_pb2 import (
    Alarm,
    AlarmState,
    Health,
    Power,
    Priority,
    Promise,
    Quality,
    Sample,
    Suspect,
)
from reactorwatch.description.read import find_process

S = 10**9
START_NS = 1_000 * S


def encoded(key: str, message: Message, at_s: float = 0.0) -> Encoded:
    return Encoded(f"reactor/{key}", *encode_message(message), START_NS + round(at_s * S))


def alarm(name: str, state: AlarmState, priority: Priority = Priority.PRIORITY_LOW) -> Alarm:
    return Alarm(time_ns=START_NS, alarm=name, state=state, priority=priority, text="what it is")


def test_a_rate_is_samples_over_the_last_ten_whole_seconds() -> None:
    board = StatusBoard(START_NS)
    for tenth in range(300):  # three samples each tenth of a second
        for signal in ("qc", "C", "T"):
            board.on_message(encoded(f"a/sample/{signal}", Sample(time_ns=1), tenth / 10))
    assert board.plant("a", START_NS + 30 * S)["samples_per_s"] == 30.0
    assert board.plant("a", START_NS + 35 * S)["samples_per_s"] == 15.0
    assert board.plant("a", START_NS + 60 * S)["samples_per_s"] == 0.0


def test_the_second_in_which_listening_began_is_not_counted() -> None:
    board = StatusBoard(START_NS + S // 2)
    for tenth in range(5, 40):
        board.on_message(encoded("a/sample/T", Sample(time_ns=1), tenth / 10))
    assert board.plant("a", START_NS + 3 * S)["samples_per_s"] == 10.0


def test_without_a_whole_second_there_is_no_rate() -> None:
    board = StatusBoard(START_NS)
    board.on_message(encoded("a/sample/T", Sample(time_ns=1)))
    assert board.plant("a", START_NS + S // 2)["samples_per_s"] is None


def test_plants_are_distinguished() -> None:
    board = StatusBoard(START_NS)
    board.on_token("reactor/b/alive/plant", True)
    board.on_message(encoded("a/health/plant", Health(time_ns=START_NS)))
    assert board.plants == ["a", "b"]
    assert [node["alive"] for node in board.plant("a", START_NS)["nodes"]] == [False]
    assert [node["alive"] for node in board.plant("b", START_NS)["nodes"]] == [True]


def test_a_node_that_goes_is_not_there() -> None:
    board = StatusBoard(START_NS)
    board.on_message(encoded("a/health/plant", Health(time_ns=START_NS, phase="running")))
    board.on_token("reactor/a/alive/plant", True)
    board.on_token("reactor/a/alive/plant", False)
    (node,) = board.plant("a", START_NS + 3 * S)["nodes"]
    assert (node["alive"], node["said_s_ago"]) == (False, 3.0)
    assert "not there" in board.text(START_NS)


def test_alarms_in_sight_are_shown_the_most_urgent_first() -> None:
    board = StatusBoard(START_NS)
    for number, (state, priority) in enumerate(
        [
            (AlarmState.ALARM_STATE_UNACKNOWLEDGED, Priority.PRIORITY_LOW),
            (AlarmState.ALARM_STATE_ACKNOWLEDGED, Priority.PRIORITY_HIGH),
            (AlarmState.ALARM_STATE_NORMAL, Priority.PRIORITY_CRITICAL),
            (AlarmState.ALARM_STATE_SHELVED, Priority.PRIORITY_CRITICAL),
        ]
    ):
        board.on_message(encoded(f"a/alarm/x/{number}", alarm(f"x/{number}", state, priority)))
    alarms = board.plant("a", START_NS)["alarms"]
    assert [(item["alarm"], item["state"]) for item in alarms] == [("x/1", "acknowledged"), ("x/0", "unacknowledged")]


def test_what_was_published_is_newer_than_what_was_listed() -> None:
    board = StatusBoard(START_NS)
    board.on_message(encoded("a/alarm/x/T", alarm("x/T", AlarmState.ALARM_STATE_ACKNOWLEDGED)))
    board.on_alarms("a", [alarm("x/T", AlarmState.ALARM_STATE_UNACKNOWLEDGED)])
    assert [item["state"] for item in board.plant("a", START_NS)["alarms"]] == ["acknowledged"]


def test_what_comes_from_the_bus_is_shown_as_it_is() -> None:
    board = StatusBoard(START_NS)
    board.on_message(encoded("a/health/plant", Health(time_ns=START_NS, phase="[/b]")))
    board.on_token("reactor/a/alive/plant", True)
    assert "[/b]" in board.text(START_NS)


def test_bytes_that_are_no_message_are_passed_over() -> None:
    board = StatusBoard(START_NS)
    board.on_message(Encoded("reactor/a/health/plant", b"\xff", "text/plain", START_NS))
    assert board.plants == []


def test_an_alarm_of_a_priority_or_state_that_this_version_does_not_know_is_shown_by_its_number() -> None:
    """`status` and `alarm list` go on beside a newer monitor."""
    odd = Alarm(alarm="x/T", priority=99, state=AlarmState.ALARM_STATE_UNACKNOWLEDGED)  # type: ignore[arg-type]
    board = StatusBoard(START_NS)
    board.on_message(encoded("a/alarm/x/T", odd))
    assert [item["priority"] for item in board.plant("a", START_NS)["alarms"]] == ["99"]
    odd.state = 88  # type: ignore[assignment]
    assert alarm_line(odd).startswith("x/T (99): 88")


def test_each_signal_has_its_newest_value_and_unit_and_a_missing_one_of_the_process_is_named() -> None:
    board = StatusBoard(START_NS, find_process("three_tanks"))
    good = Quality.QUALITY_GOOD
    for value in (1.5, 2.5):
        board.on_message(encoded("a/sample/h1", Sample(value=value, unit="mm", quality=good)))
    board.on_message(encoded("a/sample/h2", Sample(value=7.0, quality=Quality.QUALITY_BAD)))
    board.on_message(encoded("a/sample/pH", Sample(value=6.0, quality=good)))
    assert board.plant("a", START_NS)["signals"] == {
        "Q1": {"value": None, "unit": "cm3/s", "role": "input"},
        "Q2": {"value": None, "unit": "cm3/s", "role": "input"},
        "h1": {"value": 2.5, "unit": "mm", "role": "output"},
        "h2": {"value": None, "unit": "cm", "role": "output"},
        "h3": {"value": None, "unit": "cm", "role": "output"},
        "pH": {"value": 6.0, "unit": None},
    }
    assert "no Q1, Q2, h2, h3" in " ".join(board.text(START_NS).split())


def test_it_shows_values_training_the_age_of_alarms_their_cause_and_the_command_that_acknowledges_them() -> None:
    board = StatusBoard(START_NS)
    good = Quality.QUALITY_GOOD
    board.on_token("reactor/a/alive/monitor", True)
    board.on_message(encoded("a/health/monitor", Health(time_ns=START_NS, phase="training", training=0.431)))
    board.on_message(encoded("a/sample/T", Sample(time_ns=START_NS + 900 * S, value=438.54, unit="K", quality=good)))
    leak = alarm("ewma/T", AlarmState.ALARM_STATE_UNACKNOWLEDGED, Priority.PRIORITY_HIGH)
    leak.raised_ns, leak.incident = START_NS + 180 * S, 7
    leak.suspects.append(Suspect(cause="coolant_flow", probability=0.93, text="15 % of the coolant lost"))
    board.on_message(encoded("a/alarm/ewma/T", leak))
    values, node, header, row, advice = board.text(START_NS + 5 * S).splitlines()
    assert "T 438.54 K" in values
    assert " ".join(node.split()) == "monitor training 43 % 5 s ago lost 0 refused 0 lag 0.0 ms"
    assert header.split()[:2] == ["priority", "incident"]
    assert row.split("  ")[1] == "high"
    assert row.endswith("12 min  15 % of the coolant lost (93 %)")
    assert advice.endswith("reactorwatch ack --incident 7 --by NAME --plant a")
    (shown,) = board.plant("a", START_NS)["alarms"]
    assert (shown["incident"], shown["age_s"]) == (7, 720.0)


def test_alarms_are_sorted_by_priority_and_incident_and_each_line_fits() -> None:
    board = StatusBoard(START_NS)
    for name, priority, incident in (("a/1", 2, 1), ("a/2", 3, 1), ("a/3", 3, 2)):
        item = alarm(name, AlarmState.ALARM_STATE_UNACKNOWLEDGED, Priority.Name(priority))  # type: ignore[arg-type]
        item.incident, item.text = incident, "a sentence that is much longer than a terminal is wide " * 3
        board.on_message(encoded(f"p/alarm/{name}", item))
    lines = board.text(START_NS, Screen(80)).splitlines()
    shown = [line for line in lines if "…" in line]
    assert [line.split()[2] for line in shown] == ["a/3", "a/2", "a/1"]
    assert max(map(len, lines)) <= 80


NOW_NS = 10**12


def board(*, kept: bool = True) -> StatusBoard:
    power = [
        Power(deviation="coolant_flow", unit="1", within_10_min=0.0114, within_1_h=0.00512, within_1_day=0.003),
        Power(deviation="coolant_flow", unit="1", profile="ramp", within_1_day=0.02),
    ]
    message = Promise(
        time_ns=1,
        expected=1.0,
        expected_90=2.3456,
        kept=kept,
        can_keep_per_30_days=40.0,
        text="a sentence",
        power=power,
    )
    status = StatusBoard(NOW_NS)
    status.on_message(Encoded("reactor/a/promise/monitor", *encode_message(message), NOW_NS))
    status.on_token("reactor/a/alive/monitor", True)
    return status


def test_the_json_has_both_in_the_words_of_a_back_test() -> None:
    plant = board(kept=False).plant("a", NOW_NS)
    assert plant["promise"]["expected_90"] == 2.35
    assert (plant["promise"]["kept"], plant["promise"]["can_keep_per_30_days"]) == (False, 40.0)
    step, ramp = plant["power"]
    sizes = {"within_10_min": 0.0114, "within_1_h": 0.00512, "within_1_day": 0.003}
    assert step.to_dict() == {"deviation": "coolant_flow", "unit": "1", **sizes}
    assert (ramp["profile"], ramp["within_10_min"]) == ("ramp", None)


def test_people_see_the_sentence_and_the_steps_of_an_hour() -> None:
    text = board().text(NOW_NS)
    assert "a sentence" in text
    assert "coolant_flow 0.0051" in text


def test_a_plant_without_a_promise_has_none() -> None:
    status = StatusBoard(NOW_NS)
    status.on_token("reactor/b/alive/monitor", True)
    plant = status.plant("b", NOW_NS)
    assert (plant["promise"], plant["power"]) == (None, [])
    assert "promise" not in status.text(NOW_NS)
