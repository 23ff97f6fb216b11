"""`playback`: pause, resume or step a running replay, or change its rate."""

from typing import TYPE_CHECKING, Annotated

import typer

from reactorwatch.cli.command_client import TIMEOUT_S, send_command
from reactorwatch.cli.options import MAX_WAIT_S, Endpoint, Plant, Settings, parse_pace
from reactorwatch.cli.printing import print_lines
from reactorwatch.terminal import printable

if TYPE_CHECKING:
    from reactorwatch.contract.messages_pb2 import ReplayCommand

Timeout = Annotated[float, typer.Option("--timeout", help="Seconds to wait for the replay.", min=0.1, max=MAX_WAIT_S)]

playback = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


def register_commands(app: typer.Typer) -> None:
    """Register the commands."""
    app.add_typer(playback, name="playback", help="Pause a running replay, step it, or change its rate.")


def _register(command: str, description: str) -> None:
    """Register a subcommand without arguments."""

    def act(
        config: Settings = None, endpoint: Endpoint = None, name: Plant = None, timeout: Timeout = TIMEOUT_S
    ) -> None:
        from reactorwatch.contract.messages_pb2 import ReplayCommand

        _send(command, ReplayCommand(), config, endpoint, name, timeout)

    playback.command(command, help=description)(act)


_register("pause", "Pause a replay.")
_register("resume", "Resume a paused replay.")


@playback.command("step")
def step(
    rows: Annotated[int, typer.Argument(help="How many rows.", min=1, max=1_000_000_000)] = 1,
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    timeout: Timeout = TIMEOUT_S,
) -> None:
    """Publish the next rows of a paused replay."""
    from reactorwatch.contract.messages_pb2 import ReplayCommand

    _send("step", ReplayCommand(rows=rows), config, endpoint, name, timeout)


@playback.command("rate")
def rate(
    times: Annotated[str, typer.Argument(help="Times real time: a number, or 'max'.", show_default=False)],
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    timeout: Timeout = TIMEOUT_S,
) -> None:
    """Change the rate of a replay."""
    from reactorwatch.contract.messages_pb2 import ReplayCommand

    _send("set_rate", ReplayCommand(rate=parse_pace(times, "rate")), config, endpoint, name, timeout)


def _send(
    command: str, message: "ReplayCommand", config: Settings, endpoint: Endpoint, name: Plant, timeout: float
) -> None:
    import os

    message.by = printable(os.environ.get("USER", ""))  # its bytes may be no UTF-8, which a message cannot carry
    print_lines(send_command("replay", config, endpoint, name, timeout, command, message).text)
