"""`baseline`: what a running monitor judges its plant by: accept, relearn, restore, list."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from reactorwatch.cli.alarm import MONITOR, Timeout
from reactorwatch.cli.command_client import TIMEOUT_S, send_command
from reactorwatch.cli.options import Endpoint, Json, Plant, Settings, check_encodable
from reactorwatch.cli.printing import print_lines

if TYPE_CHECKING:
    from reactorwatch.contract.messages_pb2 import Baseline, CommandReply

By = Annotated[str, typer.Option("--by", help="Your name.", callback=check_encodable, show_default=False)]
Why = Annotated[str, typer.Option("--why", help="Reason, for the record.", callback=check_encodable)]

COMMAND = "baseline"

baselines = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


def register_commands(app: typer.Typer) -> None:
    """Register the commands."""
    app.add_typer(baselines, name=COMMAND, help="Accept, relearn or restore the baseline of a plant.")


def _register(what: str, description: str) -> None:
    """Register a subcommand without a number."""

    def act(
        by: By,
        why: Why,
        config: Settings = None,
        endpoint: Endpoint = None,
        name: Plant = None,
        timeout: Timeout = TIMEOUT_S,
        json: Json = False,
    ) -> None:
        _send(what, by, why, None, (config, endpoint, name, timeout), json=json)

    baselines.command(what, help=description)(act)


_register("accept", "Take the plant as it is now as sound: learn from the rows since the active alarm on.")
_register("relearn", "Learn the plant again, from the next row on.")


@baselines.command("restore")
def restore(
    by: By,
    why: Why,
    number: Annotated[
        int | None, typer.Option("--id", help="As `baseline list` has it; the one before.", min=0, max=2**63 - 1)
    ] = None,
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    timeout: Timeout = TIMEOUT_S,
    json: Json = False,
) -> None:
    """Judge the plant by what was learned before."""
    _send("restore", by, why, number, (config, endpoint, name, timeout), json=json)


@baselines.command("list")
def list_baselines(
    by: Annotated[str, typer.Option("--by", help="Your name.", callback=check_encodable, show_default=False)] = "",
    why: Annotated[str, typer.Option("--why", help="Not needed.", callback=check_encodable, show_default=False)] = "",
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    timeout: Timeout = TIMEOUT_S,
    json: Json = False,
) -> None:
    """List the baselines that can be restored, and the one in force."""
    _send("list", by, why, None, (config, endpoint, name, timeout), json=json)


def _send(
    what: str,
    by: str,
    why: str,
    number: int | None,
    options: tuple[Path | None, str | None, str | None, float],
    *,
    json: bool,
) -> None:
    """Send a command and print the answer."""
    from reactorwatch.contract.messages_pb2 import BaselineCommand

    command = BaselineCommand(what=what, by=by, why=why)
    if number is not None:
        command.id = number
    config, endpoint, name, timeout = options
    reply = send_command(MONITOR, config, endpoint, name, timeout, COMMAND, command)
    print_lines(*_lines(reply, json=json))


def _lines(reply: "CommandReply", *, json: bool) -> list[str]:
    import msgspec

    if json:
        return [msgspec.json.encode(_object(item)).decode() for item in reply.baselines]
    return [_line(item) for item in reply.baselines] or [reply.text]


def _object(item: "Baseline") -> dict[str, object]:
    fields: dict[str, object] = {
        "id": item.id,
        "what": item.what,
        "by": item.by,
        "why": item.why,
        "time_ns": item.time_ns or None,
    }
    return fields | ({"restored": item.restored} if item.what == "restore" else {})


def _line(item: "Baseline") -> str:
    from reactorwatch.contract.alarm_text import format_moment

    since = f" from {format_moment(item.time_ns)}" if item.time_ns else " from the start"
    restored = f" {item.restored}" if item.what == "restore" else ""
    return f"{item.id}: {item.what}{restored} by {item.by or 'monitor'}{since}" + (f": {item.why}" if item.why else "")
