"""Client for commands to a running node."""

from typing import TYPE_CHECKING

from reactorwatch.cli.options import ClientOptions
from reactorwatch.errors import InputError

if TYPE_CHECKING:
    from google.protobuf.message import Message

    from reactorwatch.contract.messages_pb2 import CommandReply

MONITOR = "monitor"


class NoReplyError(InputError):
    """No such node replied."""


class LateReplyError(NoReplyError):
    """Such a node runs, and did not reply in time."""


def send_command(node: str, client: ClientOptions, name: str, message: "Message") -> "CommandReply":
    """Send a command to a node and return its reply.

    Args:
        node: `monitor` or `recorder`: the node named in errors, whose settings name the plant.
        client: where it is sent; without a plant, to that of the settings, else `cstr`.
        name: name of the command.
        message: message of the command.

    Raises:
        InputError: no router within the time, or the node refuses the command.
        NoReplyError: no such node replied.
        LateReplyError: a node that runs did not reply within the time.
    """
    import threading
    import time

    from reactorwatch.cli.observer import load_settings
    from reactorwatch.contract import keys
    from reactorwatch.contract.codec import Encoded, decode, encode_message
    from reactorwatch.contract.messages_pb2 import CommandReply
    from reactorwatch.runtime.bus_zenoh import connect
    from reactorwatch.runtime.event_loop import StopSignal

    tables, bus_config = load_settings(client)
    timeout_s = client.timeout
    try:
        plant = keys.check_plant(client.name or str(tables.get(node, {}).get("plant") or keys.DEFAULT_PLANT))
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
    asked_s = time.monotonic()
    try:
        answers = bus.query(Encoded(keys.key(plant, keys.COMMAND, name), *encode_message(message)), timeout_s)
        waited_s = time.monotonic() - asked_s
    finally:
        bus.close()
    replies = [decode(answer.payload, answer.encoding) for answer in answers]
    reply = next((item for item in replies if isinstance(item, CommandReply)), None)
    if reply is None and waited_s >= timeout_s:  # the router ends a query at once that no node takes
        raise LateReplyError(
            f"the {node} of plant {plant!r} did not answer within {timeout_s:g} s; give it a longer --timeout"
        )
    if reply is None:
        refused = ", and may this certificate ask it?" if bus_config.ca is not None else "?"  # refusals are silent
        raise NoReplyError(f"no {node} of plant {plant!r} answered within {timeout_s:g} s; is it running{refused}")
    if not reply.accepted:
        raise InputError(reply.text)
    return reply
