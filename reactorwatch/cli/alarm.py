"""`alarm`: an operator's commands for alarms of the running monitor, and of the recorder for its own."""

import contextlib
from typing import TYPE_CHECKING, Annotated

import typer

from reactorwatch.cli.command_client import TIMEOUT_S, NoReplyError, send_command
from reactorwatch.cli.options import MAX_WAIT_S, Endpoint, Json, Plant, Settings, check_encodable
from reactorwatch.cli.printing import print_lines
from reactorwatch.contract.keys import ACKNOWLEDGE_RECORDER, LIST_RECORDER_ALARMS, RECORDING
from reactorwatch.errors import InputError

if TYPE_CHECKING:
    from reactorwatch.contract.messages_pb2 import Alarm, CommandReply

Name = Annotated[
    str, typer.Argument(help="As `alarm list` names it: shewhart/T.", callback=check_encodable, show_default=False)
]
By = Annotated[str, typer.Option("--by", help="Who you are.", callback=check_encodable, show_default=False)]
Comment = Annotated[str, typer.Option("--comment", help="Why.", callback=check_encodable, show_default=False)]
Timeout = Annotated[float, typer.Option("--timeout", help="Seconds to wait for the monitor.", min=0.1, max=MAX_WAIT_S)]

MONITOR, RECORDER = "monitor", "recorder"

alarms = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


def register_commands(app: typer.Typer) -> None:
    """Register the commands."""
    app.add_typer(alarms, name="alarm", help="List, acknowledge, shelve, suppress or comment the alarms of a plant.")


@alarms.command("list")
def list_alarms(
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    timeout: Timeout = TIMEOUT_S,
    json: Json = False,
) -> None:
    """Show the current state of all alarms."""
    from reactorwatch.contract.messages_pb2 import ListAlarms

    reply = send_command(MONITOR, config, endpoint, name, timeout, "list_alarms", ListAlarms())
    _show(reply, json=json)
    with contextlib.suppress(NoReplyError):  # a plant may be watched and not be recorded
        _show(send_command(RECORDER, config, endpoint, name, timeout, LIST_RECORDER_ALARMS, ListAlarms()), json=json)


@alarms.command("shelve")
def shelve(
    alarm: Name,
    by: By,
    minutes: Annotated[float, typer.Option("--minutes", help="How long, in minutes of plant time.")],
    comment: Comment = "",
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    timeout: Timeout = TIMEOUT_S,
    json: Json = False,
) -> None:
    """Hide an alarm for a time."""
    from reactorwatch.contract.messages_pb2 import ShelveAlarm

    node, command_name = _route(alarm, "shelve")
    command = ShelveAlarm(alarm=alarm, by=by, comment=comment, minutes=minutes)
    _show(send_command(node, config, endpoint, name, timeout, command_name, command), json=json)


def _register(word: str, command: str, description: str) -> None:
    """Register a subcommand with an alarm and an operator's name as arguments."""

    def act(
        alarm: Name,
        by: By,
        comment: Comment = "",
        config: Settings = None,
        endpoint: Endpoint = None,
        name: Plant = None,
        timeout: Timeout = TIMEOUT_S,
        json: Json = False,
    ) -> None:
        from reactorwatch.contract.messages_pb2 import AlarmCommand

        node, command_name = _route(alarm, command)
        message = AlarmCommand(alarm=alarm, by=by, comment=comment)
        _show(send_command(node, config, endpoint, name, timeout, command_name, message), json=json)

    alarms.command(word, help=description)(act)


for _word, _command, _description in (
    ("acknowledge", "acknowledge", "Acknowledge an alarm."),
    ("unshelve", "unshelve", "Show a shelved alarm again before its time is over."),
    ("suppress", "suppress", "Hide an alarm while it has no meaning, as in a start-up."),
    ("unsuppress", "unsuppress", "Show a suppressed alarm again."),
    ("out-of-service", "take_out_of_service", "Take an alarm out of service, for maintenance."),
    ("in-service", "return_to_service", "Return an alarm to service."),
    ("comment", "comment", "Comment on an alarm, with --comment."),
):
    _register(_word, _command, _description)


def _route(alarm: str, command: str) -> tuple[str, str]:
    """Node that raises an alarm, and its name of the command.

    Raises:
        InputError: the recorder's own alarm, and a command other than to acknowledge.
    """
    if not alarm.startswith(f"{RECORDING}/"):
        return MONITOR, command
    if command != "acknowledge":
        raise InputError(f"alarm {alarm} is the recorder's own, and can be acknowledged and nothing else")
    return RECORDER, ACKNOWLEDGE_RECORDER


def _show(reply: "CommandReply", *, json: bool) -> None:
    """Print the alarms of a reply, one JSON object or text a line."""
    import msgspec

    for alarm in reply.alarms:
        print_lines(msgspec.json.encode(_object(alarm)).decode() if json else _line(alarm))


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
        "suspect": [{"cause": item.cause, "probability": item.probability} for item in alarm.suspects],
        "by": alarm.by,
        "comment": alarm.comment,
    }


def _line(alarm: "Alarm") -> str:
    from reactorwatch.contract.alarm_text import format_moment, priority_word, state_word, suspects_text

    parts = [f"{alarm.alarm} ({priority_word(alarm.priority)}): {state_word(alarm.state)}"]
    if alarm.shelved_until_ns:
        parts.append(f"until {format_moment(alarm.shelved_until_ns)}")
    if alarm.incident:
        first = ", first in" if alarm.first_in else ""
        parts.append(f"raised {format_moment(alarm.raised_ns)} (incident {alarm.incident}{first})")
    if alarm.text:
        parts.append(alarm.text)
    suspects = suspects_text(alarm.suspects)
    if suspects:
        parts.append(f"suspect: {suspects}")
    if alarm.by:
        parts.append(f"{alarm.by}: {alarm.comment}" if alarm.comment else alarm.by)
    return "; ".join(parts)
