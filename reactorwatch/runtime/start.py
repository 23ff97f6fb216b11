"""Start of a node: it joins the bus under its own name, and waits for other nodes and what the machine refuses.

A node shows a liveliness token once it is subscribed.
"""

import os
import random
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any

import structlog

from reactorwatch import __version__
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication, encode
from reactorwatch.contract.messages_pb2 import Health
from reactorwatch.errors import UnavailableError, is_passing
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.bus import Bus
from reactorwatch.runtime.bus_zenoh import LEASE_S, ZenohBus
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import Result, StopSignal, describe, retry

log = structlog.get_logger()

GONE_WITHIN_S = LEASE_S + 2.0
"""Time after which the token of an instance that died without closing its connection has disappeared."""
LOOK_AGAIN_S = (0.1, 0.5)
"""Bounds of the random time between two looks: of two instances that start at once, one looks first."""


def instance_name() -> str:
    """Name of an instance of a node, unique, with its process and host: `0f3a9c21.4711@pi4`."""
    host = re.sub(r"[^A-Za-z0-9_.-]", "-", socket.gethostname())
    return f"{secrets.token_hex(4)}.{os.getpid()}@{host}"


@contextmanager
def join(config: BusConfig, node: str, stop: StopSignal, *tokens: str, **options: Any) -> Iterator[ZenohBus | None]:
    """Connect a node to the bus and claim its name, while the context lasts.

    Args:
        config: address of the router.
        node: name of the node.
        stop: ends the waits.
        tokens: instance tokens of the node, one for each of its plants.
        options: options of `bus_zenoh.connect`.

    Yields:
        The open bus; None if a stop was requested before.

    Raises:
        UnavailableError: another instance of the node is alive, or a passing state of the machine ended the node.
        InputError: Zenoh does not understand the endpoint.
    """
    bus = bus_zenoh.connect(config, node, stop, **options)
    if bus is None:
        yield None
        return
    try:
        yield bus if all(claim_name(bus, node, token, stop) for token in tokens) else None
    except Exception as error:
        if is_passing(error):
            raise UnavailableError(describe(error)) from error
        raise
    finally:
        bus.close()


def claim_name(bus: Bus, node: str, token: str, stop: StopSignal) -> bool:
    """Declare the instance token of a node once no other instance of it is alive; returns False if stopped before.

    The instance looks before and after it declares its token: of two that start at once, at least one sees the other.

    Raises:
        UnavailableError: another instance is alive for longer than one that died would seem to be.
    """
    instances, until, is_logged = f"{token.rpartition('/')[0]}/*", time.monotonic() + GONE_WITHIN_S, False
    while not stop.is_set:
        if not (others := bus.query_tokens(instances)):
            bus.declare_token(token)
            if not (others := [other for other in bus.query_tokens(instances) if other != token]):
                return True
            bus.undeclare_token(token)
        plant, name = token.split("/")[1], others[0].rpartition("/")[2]
        process, _, host = name.partition(".")[2].partition("@")
        if time.monotonic() > until:
            of, option = (
                ("the same plants and shard", "other --plants or another --shard")
                if plant == keys.FLEET
                else (f"plant {plant!r}", "another --plant")
            )
            raise UnavailableError(
                f"another {node} of {of} is alive, as process {process} on {host}: stop one of them, or give this "
                f"one {option}"
            )
        if not is_logged:
            log.warning("another is alive: waiting for its end", node=node, plant=plant, host=host, process=process)
            is_logged = True
        stop.wait(random.uniform(*LOOK_AGAIN_S))  # noqa: S311 (no secret)
    return False


def wait_ready(
    attempt: Callable[[], Result], bus: Bus, node: str, plant: str | None, stop: StopSignal
) -> Result | None:
    """Call a function of a node's start until the machine lets it succeed; the log and health say what is waited for.

    A node of no single plant, so with None, publishes no health.

    Returns:
        Its result; None if a stop was requested first.
    """

    def on_failure(reason: str, is_new: bool) -> None:
        if is_new:
            log.warning("waiting", node=node, why=reason)
        if plant is None:
            return
        health = Health(time_ns=time.time_ns(), node=node, version=__version__, phase=keys.BLOCKED, waiting_for=reason)
        bus.publish(encode(Publication(keys.key(plant, keys.HEALTH, node), health)))

    return retry(attempt, stop.wait, on_failure)


def wait_alive(bus: Bus, plant: str, nodes: Collection[str], stop: StopSignal, waiting: str) -> bool:
    """Wait until nodes of a plant are alive, all at the same time.

    Args:
        bus: an open bus.
        plant: name of the plant.
        nodes: names of the nodes.
        stop: ends the wait.
        waiting: name of the waiting node, for a line in the log now and every half minute.

    Returns:
        True once they are all alive; False if a stop was requested first.
    """
    changed = threading.Event()
    alive: set[str] = set()

    def on_token(key: str, is_alive: bool) -> None:
        topic = keys.parse(key)
        if topic is not None:
            (alive.add if is_alive else alive.discard)(topic.name)
            changed.set()

    stop.call_on_set(changed.set)
    if nodes:
        bus.subscribe_liveliness(keys.all_keys(plant, keys.ALIVE), on_token)
    while True:
        changed.clear()  # before the check: a later change wakes the wait below
        missing = [node for node in nodes if node not in alive]
        if stop.is_set or not missing:
            return not stop.is_set
        log.info("waiting", node=waiting, for_=", ".join(missing))
        changed.wait(30.0)
