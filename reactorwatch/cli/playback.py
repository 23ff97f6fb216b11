"""`playback`: pause a running replay, let it go on, step it, or change its rate."""

from typing import TYPE_CHECKING, Annotated

import typer

from reactorwatch.cli.command_client import PATIENCE_S, ask
from reactorwatch.cli.options import LONGEST_WAIT_S, Endpoint, Plant, Settings, pace
from reactorwatch.cli.printing import say
from reactorwatch.terminal import printable

if TYPE_CHECKING:
    from reactorwatch.contract.messages_pb2 import ReplayCommand

Timeout = Annotated[
    float, typer.Option("--timeout", help="Seconds to wait for the replay.", min=0.1, max=LONGEST_WAIT_S)
]

playback = typer.Typer(no_args_is_help=True, rich_markup_mode=None)


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    app.add_typer(playback, name="playback", help="Pause a running replay, step it, or change its rate.")


@playback.command("pause")
def pause(
    config: Settings = None, endpoint: Endpoint = None, name: Plant = None, timeout: Timeout = PATIENCE_S
) -> None:
    """Hold a replay where it is."""
    from reactorwatch.contract.messages_pb2 import ReplayCommand

    _tell("pause", ReplayCommand(), config, endpoint, name, timeout)


@playback.command("resume")
def resume(
    config: Settings = None, endpoint: Endpoint = None, name: Plant = None, timeout: Timeout = PATIENCE_S
) -> None:
    """Let a replay that is paused go on."""
    from reactorwatch.contract.messages_pb2 import ReplayCommand

    _tell("resume", ReplayCommand(), config, endpoint, name, timeout)


@playback.command("step")
def step(
    rows: Annotated[int, typer.Argument(help="How many rows.", min=1, max=1_000_000_000)] = 1,
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    timeout: Timeout = PATIENCE_S,
) -> None:
    """Publish the next rows of a replay that is paused."""
    from reactorwatch.contract.messages_pb2 import ReplayCommand

    _tell("step", ReplayCommand(rows=rows), config, endpoint, name, timeout)


@playback.command("rate")
def rate(
    times: Annotated[str, typer.Argument(help="Times real time: a number, or 'max'.", show_default=False)],
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    timeout: Timeout = PATIENCE_S,
) -> None:
    """Change how fast a replay goes."""
    from reactorwatch.contract.messages_pb2 import ReplayCommand

    _tell("set_rate", ReplayCommand(rate=pace(times, "rate")), config, endpoint, name, timeout)


def _tell(
    command: str, message: "ReplayCommand", config: Settings, endpoint: Endpoint, name: Plant, timeout: float
) -> None:
    import os

    message.by = printable(os.environ.get("USER", ""))  # its bytes may be no UTF-8, which a message cannot carry
    say(ask("replay", config, endpoint, name, timeout, command, message).text)
