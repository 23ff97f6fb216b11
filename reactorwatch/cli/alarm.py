"""`alarm`: an operator's commands for alarms of the running monitor, and of the recorder for its own."""

import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from reactorwatch.cli.command_client import TIMEOUT_S, LateReplyError, NoReplyError, send_command
from reactorwatch.cli.options import MAX_WAIT_S, Endpoint, Json, Plant, Settings, check_encodable
from reactorwatch.cli.printing import print_lines
from reactorwatch.contract.keys import ACKNOWLEDGE_RECORDER, LIST_RECORDER_ALARMS, RECORDING
from reactorwatch.errors import InputError

if TYPE_CHECKING:
    from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand

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
    app.command("ack", help="Acknowledge alarms: short for `alarm acknowledge`.")(acknowledge)


@alarms.command("list")
def list_alarms(
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    timeout: Timeout = TIMEOUT_S,
    normal: Annotated[bool, typer.Option("--normal", help="Normal ones, too.")] = False,
    json: Json = False,
) -> None:
    """Show the alarms that are not normal, the most urgent first; --json has all of them."""
    alarms = _list(config, endpoint, name, timeout)
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
    advice = advise_acknowledgement(shown, name)
    if advice:
        print_headline(advice, FAINT)


@alarms.command("acknowledge")
def acknowledge(
    by: By,
    alarm: Annotated[
        str | None,
        typer.Argument(help="As `alarm list` names it: shewhart/T.", callback=check_encodable, show_default=False),
    ] = None,
    incident: Annotated[
        int | None, typer.Option("--incident", help="All alarms of this incident.", min=1, max=2**63 - 1)
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="All alarms, of every incident.")] = False,
    comment: Comment = "",
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    timeout: Timeout = TIMEOUT_S,
    json: Json = False,
) -> None:
    """Acknowledge an alarm, those of an incident, or all."""
    from reactorwatch.contract.messages_pb2 import AlarmCommand

    if (alarm is not None) + (incident is not None) + every != 1:
        raise InputError("name one of: an alarm such as shewhart/T, --incident N, or --all")
    if alarm is not None:
        chosen = [AlarmCommand(alarm=alarm)]
    elif incident is not None:
        chosen = [AlarmCommand(incident=incident)]
    else:
        chosen = _acknowledge_all(_list(config, endpoint, name, timeout))
    changed: list[Alarm] = []
    for command in chosen:
        command.by, command.comment = by, comment
        node, command_name = _route(command.alarm, "acknowledge")
        changed += send_command(node, config, endpoint, name, timeout, command_name, command).alarms
    _show(changed, json=json)


alarms.command("ack", help="Short for acknowledge.")(acknowledge)


def _list(config: Path | None, endpoint: str | None, name: str | None, timeout: float) -> "list[Alarm]":
    """Alarms of the monitor and of the recorder."""
    from reactorwatch.contract.messages_pb2 import ListAlarms

    listed = list(send_command(MONITOR, config, endpoint, name, timeout, "list_alarms", ListAlarms()).alarms)
    try:
        listed += send_command(RECORDER, config, endpoint, name, timeout, LIST_RECORDER_ALARMS, ListAlarms()).alarms
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
    _show(send_command(node, config, endpoint, name, timeout, command_name, command).alarms, json=json)


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
        _show(send_command(node, config, endpoint, name, timeout, command_name, message).alarms, json=json)

    alarms.command(word, help=description)(act)


for _word, _command, _description in (
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
    if not _is_recorders(alarm):
        return MONITOR, command
    if command != "acknowledge":
        raise InputError(f"alarm {alarm} is the recorder's own, and can be acknowledged and nothing else")
    return RECORDER, ACKNOWLEDGE_RECORDER


def _is_recorders(alarm: str) -> bool:
    return alarm.startswith(f"{RECORDING}/")


def _show(alarms: "Iterable[Alarm]", *, json: bool) -> None:
    """Print alarms, one JSON object or text a line."""
    import msgspec

    for alarm in alarms:
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
