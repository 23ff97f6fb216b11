"""Alarms as rows for people: sorted by priority and incident, causes in words."""

from collections.abc import Iterable
from typing import NamedTuple

from reactorwatch.cli.display import ATTENTION, CAUSE, FAINT, STRONG, WRONG, Cell, Row, format_age
from reactorwatch.contract.alarm_text import describe_suspects, priority_word, state_word
from reactorwatch.contract.keys import RECORDING
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Priority

HEADER = tuple(Cell(word, FAINT) for word in ("priority", "incident", "alarm", "state", "for", "likely cause"))
SECOND_NS = 1_000_000_000
UNACKNOWLEDGED = (AlarmState.ALARM_STATE_UNACKNOWLEDGED, AlarmState.ALARM_STATE_RETURNED_UNACKNOWLEDGED)
ANNUNCIATED = (*UNACKNOWLEDGED, AlarmState.ALARM_STATE_ACKNOWLEDGED)
_STYLES = {
    Priority.PRIORITY_CRITICAL: WRONG,
    Priority.PRIORITY_HIGH: WRONG,
    Priority.PRIORITY_MEDIUM: ATTENTION,
}


def sort_alarms(alarms: Iterable[Alarm]) -> list[Alarm]:
    """Alarms by priority, the most urgent first, then by incident, the newest first, then by time."""
    return sorted(alarms, key=lambda alarm: (-alarm.priority, -alarm.incident, alarm.raised_ns, alarm.alarm))


class Now(NamedTuple):
    """Present times, in ns: an alarm's age is in that of the node that raises it.

    Attributes:
        plant: plant time, of the monitor's alarms.
        clock: clock time, of the recorder's alarms.
    """

    plant: int
    clock: int


def age_s(alarm: Alarm, now: Now) -> float | None:
    """Seconds since an alarm was raised; None if it is not annunciated."""
    if not alarm.raised_ns or alarm.state not in ANNUNCIATED:
        return None
    now_ns = now.clock if alarm.alarm.startswith(f"{RECORDING}/") else now.plant
    return (now_ns - alarm.raised_ns) / SECOND_NS


def alarm_row(alarm: Alarm, now: Now) -> Row:
    """Cells of an alarm, in the order of `HEADER`."""
    age = age_s(alarm, now)
    unseen = alarm.state in UNACKNOWLEDGED
    cause = describe_suspects(alarm.suspects)
    return (
        Cell(priority_word(alarm.priority), _STYLES.get(alarm.priority, "")),
        str(alarm.incident or ""),
        Cell(alarm.alarm, STRONG if unseen else ""),
        state_word(alarm.state),
        "" if age is None else format_age(age),
        Cell(cause, CAUSE) if cause else alarm.text,
    )


def alarm_rows(alarms: Iterable[Alarm], now: Now) -> list[Row]:
    """Header and a row for each alarm, sorted."""
    return [HEADER, *(alarm_row(alarm, now) for alarm in sort_alarms(alarms))]


def advise_acknowledgement(alarms: Iterable[Alarm], plant: str | None = None) -> str:
    """Command that acknowledges the latest incident with an unacknowledged alarm; empty if there is none."""
    incidents = [alarm.incident for alarm in alarms if alarm.state in UNACKNOWLEDGED]
    number = max(incidents, default=0)
    if not number:
        return ""
    of_plant = f" --plant {plant}" if plant is not None else ""
    return f"seen? reactorwatch ack --incident {number} --by NAME{of_plant}"
