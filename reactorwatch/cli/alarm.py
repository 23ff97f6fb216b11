"""`alarm`: an operator's commands for alarms of the running monitor, and of the recorder for its own."""

import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from reactorwatch.cli.command_client import MONITOR, LateReplyError, NoReplyError, send_command
from reactorwatch.cli.option_groups import new_group
from reactorwatch.cli.options import ClientOptions, Json, check_encodable
from reactorwatch.cli.printing import json_line, print_lines
from reactorwatch.contract.keys import ACKNOWLEDGE_RECORDER, LIST_RECORDER_ALARMS, RECORDING
from reactorwatch.errors import InputError

if TYPE_CHECKING:
    from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand, ShelveAlarm

_NAME = Argument(help="As `alarm list` names it: shewhart/T.", callback=check_encodable)
Name = Annotated[str, _NAME]
By = Annotated[str, Option(help="Who you are.", callback=check_encodable)]
Comment = Annotated[str, Option(help="Why.", callback=check_encodable, show_default=False)]

RECORDER = "recorder"


def list_alarms(
    *,
    client: ClientOptions,
    normal: Annotated[bool, Option("--normal", help="Normal ones, too.")] = False,
    json: Json = False,
) -> None:
    """Show the alarms that are not normal, the most urgent first; --json has all of them."""
    alarms = _list(client)
    if json:
        _show(alarms, json=True)
        return
    from reactorwatch.cli.alarm_rows import Now, advise_acknowledgement, alarm_rows
    from reactorwatch.cli.display import FAINT, RIGHT, print_headline, print_rows
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
    """Acknowledge an alarm, those of an incident, or all."""
    from reactorwatch.contract.messages_pb2 import AlarmCommand

    if (alarm is not None) + (incident is not None) + every != 1:
        raise InputError("name one of: an alarm such as shewhart/T, --incident N, or --all")
    chosen = _acknowledge_all(_list(client)) if every else [AlarmCommand(alarm=alarm, incident=incident)]
    changed: list[Alarm] = []
    for command in chosen:
        command.by, command.comment = by, comment
        changed += _send("acknowledge", command, client)
    _show(changed, json=json)


def _list(client: ClientOptions) -> "list[Alarm]":
    """Alarms of the monitor and of the recorder."""
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
    """Commands that acknowledge all alarms: one an incident, and one for each alarm outside of incidents.

    Raises:
        InputError: there is none to acknowledge.
    """
    from reactorwatch.cli.alarm_rows import UNACKNOWLEDGED
    from reactorwatch.contract.messages_pb2 import AlarmCommand

    unseen = [alarm for alarm in alarms if alarm.state in UNACKNOWLEDGED]
    if not unseen:
        raise InputError("there is no alarm to acknowledge")
    incidents = sorted({alarm.incident for alarm in unseen if alarm.incident})
    single = [AlarmCommand(alarm=alarm.alarm) for alarm in unseen if not alarm.incident]
    return [*(AlarmCommand(incident=number) for number in incidents), *single]


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

    _show(_send("shelve", ShelveAlarm(alarm=alarm, by=by, comment=comment, minutes=minutes), client), json=json)


def _operation(command: str) -> Callable[..., None]:
    """A subcommand with an alarm and an operator's name as arguments."""

    def act(*, alarm: Name, by: By, comment: Comment = "", client: ClientOptions, json: Json = False) -> None:
        from reactorwatch.contract.messages_pb2 import AlarmCommand

        _show(_send(command, AlarmCommand(alarm=alarm, by=by, comment=comment), client), json=json)

    return act


alarms = new_group(
    {
        "list": list_alarms,
        "acknowledge": acknowledge,
        "ack": (acknowledge, "Short for acknowledge."),
        "shelve": shelve,
        "unshelve": (_operation("unshelve"), "Show a shelved alarm again before its time is over."),
        "suppress": (_operation("suppress"), "Hide an alarm while it has no meaning, as in a start-up."),
        "unsuppress": (_operation("unsuppress"), "Show a suppressed alarm again."),
        "out-of-service": (_operation("take_out_of_service"), "Take an alarm out of service, for maintenance."),
        "in-service": (_operation("return_to_service"), "Return an alarm to service."),
        "comment": (_operation("comment"), "Comment on an alarm, with --comment."),
    }
)


def _send(command: str, message: "AlarmCommand | ShelveAlarm", client: ClientOptions) -> "Iterable[Alarm]":
    """Send a command to the node that raises the alarm; returns the alarms that it changed.

    Raises:
        InputError: the recorder's own alarm, and a command other than to acknowledge.
    """
    node = MONITOR
    if _is_recorders(message.alarm):
        if command != "acknowledge":
            raise InputError(f"alarm {message.alarm} is the recorder's own, and can be acknowledged and nothing else")
        node, command = RECORDER, ACKNOWLEDGE_RECORDER
    return send_command(node, client, command, message).alarms


def _is_recorders(alarm: str) -> bool:
    return alarm.startswith(f"{RECORDING}/")


def _show(alarms: "Iterable[Alarm]", *, json: bool) -> None:
    """Print alarms, one JSON object or text a line."""
    for alarm in alarms:
        print_lines(json_line(_object(alarm)) if json else _line(alarm))


def _object(alarm: "Alarm") -> dict[str, object]:
    from reactorwatch.contract.alarm_text import priority_word, state_word

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


def _line(alarm: "Alarm") -> str:
    from reactorwatch.contract.alarm_text import describe_suspects, format_moment, priority_word, state_word

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
