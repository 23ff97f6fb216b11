"""Commands that join the bus: their settings and log, and a question to a node with its answer."""

import logging
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from google.protobuf.message import Message

from reactorwatch.cli.option_groups import BusOptions, ClientOptions, PlantOptions
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode, encode_message
from reactorwatch.contract.messages_pb2 import CommandReply
from reactorwatch.errors import InputError
from reactorwatch.runtime.acl import Role, parse_common_name
from reactorwatch.runtime.bus_zenoh import ZenohBus, connect
from reactorwatch.runtime.certificates import read_certificate, read_common_name
from reactorwatch.runtime.config import BusConfig, LogConfig, MetricsConfig, read_settings, section
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.node_main import configure_log
from recorder.config import RecorderConfig

if TYPE_CHECKING:
    from reactorwatch.description.process import Process


def load_settings(target: BusOptions, level: int = logging.WARNING) -> tuple[dict[str, dict[str, Any]], BusConfig]:
    """Configure the log; returns the tables of the settings, and the bus settings."""
    configure_log(level)
    tables = read_settings(target.config)
    return tables, section(BusConfig, "bus", tables, {"endpoint": target.endpoint})


def load_recorder_settings(target: PlantOptions, level: int = logging.WARNING) -> tuple[BusConfig, RecorderConfig]:
    """Configure the log; returns the settings of the bus, and of the recorder, which name the plant."""
    tables, bus = load_settings(target, level)
    return bus, section(RecorderConfig, "recorder", tables, {"plant": target.name})


def certificate_holder(config: BusConfig) -> tuple[str, Role] | None:
    """Plant, which is `keys.FLEET` for all plants, and role of the bus's certificate; None without one."""
    if config.certificate is None:
        return None
    return parse_common_name(read_common_name(read_certificate(Path(config.certificate))))


def is_for_all_plants(config: BusConfig) -> bool:
    """True if the bus's certificate is for all plants of a site."""
    holder = certificate_holder(config)
    return holder is not None and holder[0] == keys.FLEET


def check_one_plant(config: BusConfig, plant: str | None) -> None:
    """Check that a plant is named, where the certificate is for all of them.

    Raises:
        InputError: none is.
    """
    if plant is None and is_for_all_plants(config):
        raise InputError("this certificate is for all plants of the site; name one by --plant")


def observed_process(process: str | None, recorder: RecorderConfig) -> "Process | None":
    """Process of the plant that is observed."""
    from reactorwatch.description.read import PlantProcesses, find_process

    return PlantProcesses(recorder.processes).find(recorder.plant) if process is None else find_process(process)


def connect_within(config: BusConfig, name: str, timeout_s: float) -> ZenohBus | None:
    """Connect to the bus under a name; None if no router is there within the time."""
    stop = StopSignal()
    timer = threading.Timer(timeout_s, stop.set)
    timer.start()
    try:
        return connect(config, name, stop)
    finally:
        timer.cancel()


class NoReplyError(InputError):
    """No such node replied."""


class LateReplyError(NoReplyError):
    """Such a node runs, and did not reply in time."""


def send_command(node: str, client: ClientOptions, name: str, message: Message) -> CommandReply:
    """Send a command to a node and return its reply."""
    tables, bus_config = load_settings(client)
    timeout_s = client.timeout
    named = client.name or tables.get(node, {}).get("plant")
    check_one_plant(bus_config, named)
    try:
        plant = keys.check_plant(str(named or keys.DEFAULT_PLANT))
    except ValueError as error:
        raise InputError(str(error)) from error
    bus = connect_within(bus_config, "command", timeout_s)
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


def node_settings(target: BusOptions) -> tuple[dict[str, dict[str, Any]], BusConfig]:
    """Configure the log of a node; returns the tables of the settings, and the bus settings."""
    tables = read_settings(target.config)
    configure_log(as_json=section(LogConfig, "log", tables, {}).format == "json")
    return tables, section(BusConfig, "bus", tables, {"endpoint": target.endpoint})


def metrics_settings(tables: dict[str, dict[str, Any]]) -> MetricsConfig:
    """Settings of a node's metrics."""
    return section(MetricsConfig, "metrics", tables, {})
