"""Asking a running node something, from the command line."""

from pathlib import Path
from typing import TYPE_CHECKING

from reactorwatch.errors import InputError

if TYPE_CHECKING:
    from google.protobuf.message import Message

    from reactorwatch.contract.messages_pb2 import CommandReply

PATIENCE_S = 5.0
"""For how long, if nobody says."""


class NoAnswerError(InputError):
    """There is no such node."""


def ask(
    node: str,
    config: Path | None,
    endpoint: str | None,
    plant: str | None,
    timeout_s: float,
    name: str,
    message: "Message",
) -> "CommandReply":
    """A node's answer to a command.

    Args:
        node: `monitor`, `recorder` or `replay`, for what is said if none answers; and whose settings name the plant.
        config: settings file, or None.
        endpoint: the router's address, or None.
        plant: its name; None: that of the settings, else `cstr`.
        timeout_s: how long to wait.
        name: of the command.
        message: what it carries.

    Raises:
        InputError: no router within the time, or the node refuses.
        NoAnswerError: no such node within the time.
    """
    import threading

    from reactorwatch.cli.observer import begin
    from reactorwatch.contract import keys
    from reactorwatch.contract.codec import Encoded, decode, encode_message
    from reactorwatch.contract.messages_pb2 import CommandReply
    from reactorwatch.runtime.bus_zenoh import connect
    from reactorwatch.runtime.event_loop import StopSignal

    tables, bus_config = begin(config, endpoint)
    try:
        plant = keys.check_plant(plant or str(tables.get(node, {}).get("plant") or "cstr"))
    except ValueError as error:
        raise InputError(str(error)) from error
    stop = StopSignal()
    timer = threading.Timer(timeout_s, stop.set)
    timer.start()
    try:
        bus = connect(bus_config, "command", stop)
    finally:
        timer.cancel()
    if bus is None:
        raise InputError(f"no router at {bus_config.endpoint} within {timeout_s:g} s; is it running?")
    try:
        answers = bus.query(Encoded(keys.key(plant, keys.COMMAND, name), *encode_message(message)), timeout_s)
    finally:
        bus.close()
    replies = [decode(answer.payload, answer.encoding) for answer in answers]
    reply = next((item for item in replies if isinstance(item, CommandReply)), None)
    if reply is None:
        refused = ", and may our certificate ask it?" if bus_config.ca is not None else "?"  # refusals are silent
        raise NoAnswerError(f"no {node} of plant {plant!r} answered within {timeout_s:g} s; is it running{refused}")
    if not reply.accepted:
        raise InputError(reply.text)
    return reply
