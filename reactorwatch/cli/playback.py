"""`playback`: pause, resume or step a running replay, or change its rate."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from reactorwatch.cli.command_client import send_command
from reactorwatch.cli.option_groups import new_group
from reactorwatch.cli.options import MAX_WAIT_S, TIMEOUT_S, ClientOptions, parse_pace
from reactorwatch.cli.printing import print_lines
from reactorwatch.terminal import printable

if TYPE_CHECKING:
    from reactorwatch.contract.messages_pb2 import ReplayCommand


@dataclass(frozen=True)
class ReplayOptions(ClientOptions):
    """Settings file, router, plant and timeout of a command to a replay."""

    timeout: Annotated[float, Option(help="Seconds to wait for the replay.", min=0.1, max=MAX_WAIT_S)] = TIMEOUT_S


def _without_arguments(command: str) -> Callable[..., None]:
    def act(client: ReplayOptions) -> None:
        from reactorwatch.contract.messages_pb2 import ReplayCommand

        _send(command, ReplayCommand(), client)

    return act


def step(
    *, rows: Annotated[int, Argument(help="How many rows.", min=1, max=1_000_000_000)] = 1, client: ReplayOptions
) -> None:
    """Publish the next rows of a paused replay."""
    from reactorwatch.contract.messages_pb2 import ReplayCommand

    _send("step", ReplayCommand(rows=rows), client)


def rate(times: Annotated[str, Argument(help="Times real time: a number, or 'max'.")], client: ReplayOptions) -> None:
    """Change the rate of a replay."""
    from reactorwatch.contract.messages_pb2 import ReplayCommand

    _send("set_rate", ReplayCommand(rate=parse_pace(times, "rate")), client)


def _send(command: str, message: "ReplayCommand", client: ReplayOptions) -> None:
    import os

    message.by = printable(os.environ.get("USER", ""))  # its bytes may be no UTF-8, which a message cannot carry
    print_lines(send_command("replay", client, command, message).text)


playback = new_group(
    {
        "pause": (_without_arguments("pause"), "Pause a replay."),
        "resume": (_without_arguments("resume"), "Resume a paused replay."),
        "step": step,
        "rate": rate,
    }
)
