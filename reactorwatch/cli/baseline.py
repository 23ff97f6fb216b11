"""`baseline`: what a running monitor judges its plant by: accept, relearn, restore, list."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

from typer import Option

from reactorwatch.cli.command_client import MONITOR, send_command
from reactorwatch.cli.option_groups import new_group
from reactorwatch.cli.options import ClientOptions, Json, check_encodable
from reactorwatch.cli.printing import json_line, print_lines

if TYPE_CHECKING:
    from reactorwatch.contract.messages_pb2 import Baseline

By = Annotated[str, Option(help="Your name.", callback=check_encodable, show_default=False)]
Why = Annotated[str, Option(help="Reason, for the record.", callback=check_encodable)]

COMMAND = "baseline"


def _without_number(what: str) -> Callable[..., None]:
    def act(*, by: By, why: Why, client: ClientOptions, json: Json = False) -> None:
        _send(what, by, why, client, json=json)

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
    _send("restore", by, why, client, number, json=json)


def list_baselines(
    *,
    by: By = "",
    why: Annotated[str, Option(help="Not needed.", callback=check_encodable, show_default=False)] = "",
    client: ClientOptions,
    json: Json = False,
) -> None:
    """List the baselines that can be restored, and the one in force."""
    _send("list", by, why, client, json=json)


baselines = new_group(
    {
        "accept": (
            _without_number("accept"),
            "Take the plant as it is now as sound: learn from the rows since the active alarm on.",
        ),
        "relearn": (_without_number("relearn"), "Learn the plant again, from the next row on."),
        "restore": restore,
        "list": list_baselines,
    }
)


def _send(what: str, by: str, why: str, client: ClientOptions, number: int | None = None, *, json: bool) -> None:
    """Send a command and print the answer."""
    from reactorwatch.contract.messages_pb2 import BaselineCommand

    reply = send_command(MONITOR, client, COMMAND, BaselineCommand(what=what, by=by, why=why, id=number))
    if json:
        print_lines(*(json_line(_object(item)) for item in reply.baselines))
    else:
        print_lines(*([_line(item) for item in reply.baselines] or [reply.text]))


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
