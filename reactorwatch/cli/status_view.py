"""Alarms and the status of plants as rows for people."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from reactorwatch.cli.display import (
    ATTENTION,
    CAUSE,
    FAINT,
    GAP,
    RIGHT,
    STRONG,
    WRONG,
    Cell,
    Row,
    Screen,
    format_age,
    format_rows,
    wrap_line,
)
from reactorwatch.contract.keys import RECORDING
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Priority
from reactorwatch.sentences.alarm import describe_suspects, priority_word, state_word
from reactorwatch.sentences.promise import describe_power

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
    """Present times, in ns: an alarm's age is in that of the node that raises it."""

    plant: int  # of the monitor's alarms
    clock: int  # of the recorder's alarms


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


_INDENT = 2


def format_plant(
    plant: dict[str, Any],
    alarms: Sequence[Alarm],
    now: Now,
    to: Screen = Screen(),  # noqa: B008 (it is frozen)
) -> str:
    """Format the status of a plant, the object that `status --json` prints for it, with its annunciated alarms."""
    nodes = [_node(node) for node in plant["nodes"]]
    parts = [
        format_rows([_values(plant)], to=to),
        format_rows(nodes or [("no nodes",)], _INDENT, to),
        format_rows(_promise(plant, to.width), _INDENT, to),
    ]
    if alarms:
        advice = advise_acknowledgement(alarms, plant["plant"])
        parts.append(format_rows(alarm_rows(alarms, now), _INDENT, to))
        parts.append(format_rows([(Cell(advice, FAINT),)] if advice else [], _INDENT, to))
    else:
        parts.append(format_rows([(Cell("no alarms", RIGHT),)], _INDENT, to))
    return "\n".join(filter(None, parts))


def _values(plant: dict[str, Any]) -> Row:
    """Name of the plant, the newest value of each signal, and the rate of samples."""
    cells: list[Cell | str] = [Cell(plant["plant"], STRONG)]
    missing = []
    for name, signal in plant["signals"].items():
        if signal["value"] is None:
            missing.append(name)
        else:
            cells.append(f"{name} {signal['value']:.5g} {signal['unit'] or ''}".rstrip())
    if missing:
        cells.append(Cell(f"no {', '.join(missing)}", WRONG))
    rate = plant["samples_per_s"]
    return (*cells, *([] if rate is None else [Cell(f"{rate:.3g} samples/s", FAINT if rate else WRONG)]))


def _promise(plant: dict[str, Any], width: int | None) -> list[Row]:
    """Promise of false alarms and the power, if they are known, each wrapped beside its name."""
    promise = plant["promise"]
    if promise is None:
        return []
    is_good = promise.kept and not promise.drifted
    named = {"promise": Cell(promise.text, "" if is_good else ATTENTION)}
    if plant["power"]:
        named["seen in an hour"] = Cell(describe_power(plant["power"]), FAINT)
    room = None if width is None else width - _INDENT - max(map(len, named)) - GAP
    return [
        (name if index == 0 else "", Cell(line, style))
        for name, (text, style) in named.items()
        for index, line in enumerate(wrap_line(text, room))
    ]


def _node(node: dict[str, Any]) -> Row:
    if (why := node.get("waiting_for")) is not None:
        return (node["node"], Cell(f"{node['phase']}: {why}", WRONG), _age(node))
    if not node["alive"]:
        return (node["node"], Cell("not there", WRONG), _age(node))
    phase = node.get("phase", "")
    if "training" in node:
        phase += f" {100 * node['training']:.0f} %"
    elif "reference" in node:
        phase += f" by {node['reference']}"
    lag = f"lag {node['lag_ms']:.1f} ms" if "lag_ms" in node else ""
    return (
        node["node"],
        Cell(phase, ATTENTION if "training" in node else ""),
        _age(node),
        *(_count(node, name) for name in ("lost", "refused")),
        lag,
    )


def _count(node: dict[str, Any], name: str) -> Cell:
    if name not in node:
        return Cell("")
    return Cell(f"{name} {node[name]}", ATTENTION if node[name] else FAINT)


def _age(node: dict[str, Any]) -> Cell:
    return Cell(f"{format_age(node['said_s_ago'])} ago" if "said_s_ago" in node else "", FAINT)
