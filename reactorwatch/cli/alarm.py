"""Commands of an operator to running nodes: `alarm` and `baseline`; `ack` is short for `alarm acknowledge`."""

import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Annotated, TypeVar

from typer import Argument, Option

from reactorwatch.cli.display import FAINT, RIGHT, json_line, print_headline, print_lines, print_rows
from reactorwatch.cli.option_groups import ClientOptions, add_commands, new_group
from reactorwatch.cli.options import Json, check_encodable
from reactorwatch.contract.keys import ACKNOWLEDGE_RECORDER, LIST_RECORDER_ALARMS, RECORDING
from reactorwatch.errors import InputError

if TYPE_CHECKING:
    from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand, Baseline, ShelveAlarm

Item = TypeVar("Item")
_NAME = Argument(help="As `alarm list` names it: shewhart/T.", callback=check_encodable)
Name = Annotated[str, _NAME]
By = Annotated[str, Option(help="Your name.", callback=check_encodable, show_default=False)]
Comment = Annotated[str, Option(help="Your reason.", callback=check_encodable, show_default=False)]
Why = Annotated[str, Option(help="Reason, for the record.", callback=check_encodable)]
MONITOR, RECORDER = "monitor", "recorder"

ALARM_VERBS = {
    "unshelve": ("unshelve", "Show a shelved alarm again before its time is over."),
    "suppress": ("suppress", "Hide an alarm while it has no meaning, as in a start-up."),
    "unsuppress": ("unsuppress", "Show a suppressed alarm again."),
    "out-of-service": ("take_out_of_service", "Take an alarm out of service, for maintenance."),
    "in-service": ("return_to_service", "Return an alarm to service."),
    "comment": ("comment", "Comment on an alarm, with --comment."),
}
"""Subcommands with an alarm, a name and a comment: the command on the bus, and the help."""

BASELINE_VERBS = {
    "accept": "Take the plant as it is now as sound: learn from the rows since the active alarm on.",
    "relearn": "Learn the plant again, from the next row on.",
}
"""Subcommands with a name and a reason: the help."""


def list_alarms(
    *,
    client: ClientOptions,
    normal: Annotated[bool, Option("--normal", help="Normal ones, too.")] = False,
    json: Json = False,
) -> None:
    """Show the alarms that are not normal, the most urgent first; --json has all of them."""
    alarms = _list(client)
    if json:
        _show_alarms(alarms, json=True)
        return
    from reactorwatch.cli.status_view import Now, advise_acknowledgement, alarm_rows
    from reactorwatch.contract.messages_pb2 import AlarmState

    shown = [alarm for alarm in alarms if normal or alarm.state != AlarmState.ALARM_STATE_NORMAL]
    if not shown:
        print_headline(f"no alarms: all {len(alarms)} are normal", RIGHT)
        return
    plant_ns = max((alarm.time_ns for alarm in alarms if not _is_recorders(alarm.alarm)), default=0)
    print_rows(alarm_rows(shown, Now(plant_ns, time.time_ns())))
    advice = advise_acknowledgement(shown, client.name)
    if advice:
        print_headline(advice, FAINT)


def acknowledge(
    *,
    by: By,
    alarm: Annotated[str | None, _NAME] = None,
    incident: Annotated[int | None, Option(help="All alarms of this incident.", min=1, max=2**63 - 1)] = None,
    every: Annotated[bool, Option("--all", help="All alarms, of every incident.")] = False,
    comment: Comment = "",
    client: ClientOptions,
    json: Json = False,
) -> None:
    """Acknowledge an alarm, those of an incident, or all; `reactorwatch ack` for short."""
    from reactorwatch.contract.messages_pb2 import AlarmCommand

    if (alarm is not None) + (incident is not None) + every != 1:
        raise InputError("name one of: an alarm such as shewhart/T, --incident N, or --all")
    chosen = _acknowledge_all(_list(client)) if every else [AlarmCommand(alarm=alarm, incident=incident)]
    changed: list[Alarm] = []
    for command in chosen:
        command.by, command.comment = by, comment
        changed += _send("acknowledge", command, client)
    _show_alarms(changed, json=json)


def shelve(
    *,
    alarm: Name,
    by: By,
    minutes: Annotated[float, Option(help="How long, in minutes of plant time.")],
    comment: Comment = "",
    client: ClientOptions,
    json: Json = False,
) -> None:
    """Hide an alarm for a time."""
    from reactorwatch.contract.messages_pb2 import ShelveAlarm

    _show_alarms(_send("shelve", ShelveAlarm(alarm=alarm, by=by, comment=comment, minutes=minutes), client), json=json)


def _alarm_verb(command: str) -> Callable[..., None]:
    def act(*, alarm: Name, by: By, comment: Comment = "", client: ClientOptions, json: Json = False) -> None:
        from reactorwatch.contract.messages_pb2 import AlarmCommand

        _show_alarms(_send(command, AlarmCommand(alarm=alarm, by=by, comment=comment), client), json=json)

    return act


def restore(
    *,
    by: By,
    why: Why,
    number: Annotated[
        int | None, Option("--id", help="As `baseline list` has it; the one before.", min=0, max=2**63 - 1)
    ] = None,
    client: ClientOptions,
    json: Json = False,
) -> None:
    """Judge the plant by what was learned before."""
    _send_baseline("restore", by, why, client, number, json=json)


def list_baselines(
    *,
    by: Annotated[str, Option(hidden=True, callback=check_encodable)] = "",
    why: Annotated[str, Option(hidden=True, callback=check_encodable)] = "",
    client: ClientOptions,
    json: Json = False,
) -> None:
    """List the baselines that can be restored, and the one in force."""
    _send_baseline("list", by, why, client, json=json)


def _baseline_verb(what: str) -> Callable[..., None]:
    def act(*, by: By, why: Why, client: ClientOptions, json: Json = False) -> None:
        _send_baseline(what, by, why, client, json=json)

    return act


alarms = new_group(
    "List, acknowledge, shelve, suppress or comment the alarms of a plant.",
    {
        "list": list_alarms,
        "acknowledge": acknowledge,
        "shelve": shelve,
        **{name: (_alarm_verb(command), text) for name, (command, text) in ALARM_VERBS.items()},
    },
)
add_commands(alarms, {"ack": acknowledge}, hidden=True)
baselines = new_group(
    "Accept, relearn or restore the baseline of a plant.",
    {
        **{name: (_baseline_verb(name), text) for name, text in BASELINE_VERBS.items()},
        "restore": restore,
        "list": list_baselines,
    },
)


def _list(client: ClientOptions) -> "list[Alarm]":
    """Alarms of the monitor and of the recorder."""
    from reactorwatch.cli.bus_client import LateReplyError, NoReplyError, send_command
    from reactorwatch.contract.messages_pb2 import ListAlarms

    listed = list(send_command(MONITOR, client, "list_alarms", ListAlarms()).alarms)
    try:
        listed += send_command(RECORDER, client, LIST_RECORDER_ALARMS, ListAlarms()).alarms
    except LateReplyError as late:
        print_lines(f"the alarms of the recorder are missing: {late}", err=True)
    except NoReplyError:
        pass  # a plant may be watched and not be recorded
    return listed


def _acknowledge_all(alarms: "list[Alarm]") -> "list[AlarmCommand]":
    """Commands that acknowledge all alarms: one an incident, and one for each alarm outside of incidents."""
    from reactorwatch.cli.status_view import UNACKNOWLEDGED
    from reactorwatch.contract.messages_pb2 import AlarmCommand

    unseen = [alarm for alarm in alarms if alarm.state in UNACKNOWLEDGED]
    if not unseen:
        raise InputError("there is no alarm to acknowledge")
    incidents = sorted({alarm.incident for alarm in unseen if alarm.incident})
    single = [AlarmCommand(alarm=alarm.alarm) for alarm in unseen if not alarm.incident]
    return [*(AlarmCommand(incident=number) for number in incidents), *single]


def _send(command: str, message: "AlarmCommand | ShelveAlarm", client: ClientOptions) -> "Iterable[Alarm]":
    """Send a command to the node that raises the alarm; returns the alarms that it changed."""
    from reactorwatch.cli.bus_client import send_command

    node = MONITOR
    if _is_recorders(message.alarm):
        if command != "acknowledge":
            raise InputError(f"alarm {message.alarm} is the recorder's own, and can be acknowledged and nothing else")
        node, command = RECORDER, ACKNOWLEDGE_RECORDER
    return send_command(node, client, command, message).alarms


def _send_baseline(
    what: str, by: str, why: str, client: ClientOptions, number: int | None = None, *, json: bool
) -> None:
    """Send a command about the baseline, and print the answer."""
    from reactorwatch.cli.bus_client import send_command
    from reactorwatch.contract.messages_pb2 import BaselineCommand

    reply = send_command(MONITOR, client, "baseline", BaselineCommand(what=what, by=by, why=why, id=number))
    _show(reply.baselines, _baseline_object, _baseline_line, json=json)
    if not (json or reply.baselines):
        print_lines(reply.text)


def _is_recorders(alarm: str) -> bool:
    return alarm.startswith(f"{RECORDING}/")


def _show_alarms(alarms: "Iterable[Alarm]", *, json: bool) -> None:
    _show(alarms, _alarm_object, _alarm_line, json=json)


def _show(
    items: Iterable[Item], as_object: Callable[[Item], object], as_line: Callable[[Item], str], *, json: bool
) -> None:
    """Print one JSON object or text a line."""
    for item in items:
        print_lines(json_line(as_object(item)) if json else as_line(item))


def _alarm_object(alarm: "Alarm") -> dict[str, object]:
    from reactorwatch.sentences.alarm import priority_word, state_word

    return {
        "alarm": alarm.alarm,
        "state": state_word(alarm.state),
        "priority": priority_word(alarm.priority),
        "raised_ns": alarm.raised_ns or None,
        "cleared_ns": alarm.cleared_ns or None,
        "shelved_until_ns": alarm.shelved_until_ns or None,
        "incident": alarm.incident or None,
        "first_in": alarm.first_in,
        "text": alarm.text,
        "suspect": [
            {"cause": item.cause, "probability": item.probability, "text": item.text} for item in alarm.suspects
        ],
        "by": alarm.by,
        "comment": alarm.comment,
    }


def _alarm_line(alarm: "Alarm") -> str:
    from reactorwatch.sentences.alarm import describe_suspects, format_moment, priority_word, state_word

    parts = [f"{alarm.alarm} ({priority_word(alarm.priority)}): {state_word(alarm.state)}"]
    if alarm.shelved_until_ns:
        parts.append(f"until {format_moment(alarm.shelved_until_ns)}")
    if alarm.incident:
        first = ", first in" if alarm.first_in else ""
        parts.append(f"raised {format_moment(alarm.raised_ns)} (incident {alarm.incident}{first})")
    if alarm.text:
        parts.append(alarm.text)
    suspects = describe_suspects(alarm.suspects)
    if suspects:
        parts.append(f"likely cause: {suspects}")
    if alarm.by:
        parts.append(f"{alarm.by}: {alarm.comment}" if alarm.comment else alarm.by)
    return "; ".join(parts)


def _baseline_object(item: "Baseline") -> dict[str, object]:
    found: dict[str, object] = {
        "id": item.id,
        "what": item.what,
        "by": item.by,
        "why": item.why,
        "time_ns": item.time_ns or None,
    }
    return found | ({"restored": item.restored} if item.what == "restore" else {})


def _baseline_line(item: "Baseline") -> str:
    from reactorwatch.sentences.alarm import format_moment

    since = f" from {format_moment(item.time_ns)}" if item.time_ns else " from the start"
    restored = f" {item.restored}" if item.what == "restore" else ""
    return f"{item.id}: {item.what}{restored} by {item.by or 'monitor'}{since}" + (f": {item.why}" if item.why else "")
