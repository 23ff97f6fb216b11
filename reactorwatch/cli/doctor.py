"""`doctor`: checks of a deployment from this machine with these settings.

A router refuses messages silently, so a node without the right to publish looks like one with nothing to publish. The
doctor therefore publishes a message and receives it in a second session of the same certificate: below `@doctor`, where
the same role may publish the same kinds, and no node subscribes. It checks the Dask cluster of a fleet, too.
"""

import shutil
import stat
import threading
import time
from collections.abc import Iterator
from datetime import datetime
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cryptography.exceptions import InvalidSignature
from cryptography.x509 import Certificate

from monitor_node.health import OtherMonitors
from reactorwatch.cli.bus_client import certificate_holder, is_for_all_plants
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.messages_pb2 import Health
from reactorwatch.errors import InputError
from reactorwatch.runtime.acl import FLEET, kinds_of
from reactorwatch.runtime.bus_zenoh import ZenohBus, connect_now
from reactorwatch.runtime.certificates import read_certificate, read_common_name, read_key
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.jobs import inspect_cluster, one_line
from reactorwatch.runtime.provisioning import CA, CERTIFICATE, CLUSTER_SETTINGS
from reactorwatch.version import version

if TYPE_CHECKING:
    from monitor_node.fleet import FleetConfig

RENEW_DAYS = 30
"""As `certify --renew 30` in the cure: a month to plan it."""
MAX_OFFSET_S = 1.0
"""Far above what NTP leaves, and below a period of samples."""
REPEAT_S = 0.2
"""A subscription takes effect within it on a network of one site."""
LOST_WITHIN_S = 10.0
"""Dask takes five minutes by default to notice that a worker was stopped, and nothing watches its plants meanwhile."""
NODES = ("plant", "monitor", "recorder")


class Finding(NamedTuple):
    """Result of one check."""

    check: str
    found: str
    cure: str = ""  # empty if nothing is wrong


def run_checks(
    config: BusConfig, plant: str, folder: Path, room_mb: float, timeout_s: float, now: datetime
) -> Iterator[Finding]:
    """Run the checks of a deployment; those that need a router are skipped without one."""
    yield from _check_certificate(config, plant, now)
    yield _check_disk(folder, room_mb)
    try:
        bus = connect_now(config)
    except ConnectionError as error:
        cure = "start it, or correct endpoint in [bus]"
        if config.ca is not None:
            cure += "; or, if it is there, its certificate is not for this host, or one of both is of another authority"
        yield Finding("router", f"no way in at {config.endpoint}: {error}", cure)
        return
    try:
        yield Finding("router", f"lets us in at {config.endpoint}")
        yield from _check_publishing(bus, config, plant, timeout_s)
        is_one = plant != FLEET or not is_for_all_plants(config)
        yield from _check_nodes(bus, plant, timeout_s) if is_one else _check_all_nodes(bus, timeout_s)
    finally:
        bus.close()


def _check_certificate(config: BusConfig, plant: str, now: datetime) -> Iterator[Finding]:
    if config.ca is None or config.certificate is None or config.key is None:
        if _is_loopback(config.endpoint):
            yield Finding("certificate", "none, and the bus is on this machine's loopback only")
        else:
            cure = "make certificates with `reactorwatch certify`"
            yield Finding(
                "certificate", f"none: every program that reaches {config.endpoint} may publish and command", cure
            )
        return
    own, ca = read_certificate(Path(config.certificate)), read_certificate(Path(config.ca))
    name = read_common_name(own)
    yield _check_dates("certificate", own, now)
    yield _check_dates("authority", ca, now)
    key_file = Path(config.key)
    try:
        own.verify_directly_issued_by(ca)
    except (ValueError, TypeError, InvalidSignature):
        yield Finding(
            "identity", f"{name} is not signed by the authority in {config.ca}", "copy its whole folder again"
        )
    if read_key(key_file).public_key() != own.public_key():
        yield Finding("identity", f"{config.key} is not the key of {config.certificate}", "copy its whole folder again")
    if stat.S_IMODE(key_file.stat().st_mode) & 0o077:
        yield Finding("private key", f"{key_file} can be read by others", f"chmod 600 {key_file}")
    holder = certificate_holder(config)
    if holder is None or holder[0] not in (plant, keys.FLEET):
        cure = f"use a certificate of {plant}, or name its plant by --plant"
        yield Finding("identity", f"{name or 'a certificate without a name'}: has no role of plant {plant}", cure)


def _check_dates(what: str, certificate: Certificate, now: datetime) -> Finding:
    remaining = certificate.not_valid_after_utc - now
    until = f"valid until {certificate.not_valid_after_utc:%Y-%m-%d %H:%M} UTC, {remaining.days} days"
    holder_name = read_common_name(certificate)
    if now < certificate.not_valid_before_utc:
        begin = f"{certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC"
        return Finding(what, f"{holder_name}: not valid before {begin}", "set this machine's clock, or make it again")
    if remaining.days < RENEW_DAYS:
        passed = remaining.total_seconds() <= 0
        renew = "renew it: `reactorwatch certify SITE --renew 30`, and copy the new folder"
        return Finding(what, f"{holder_name}: expired" if passed else f"{holder_name}: {until}", renew)
    return Finding(what, f"{holder_name}: {until}")


def check_cluster(fleet: "FleetConfig", bus: BusConfig, now: datetime) -> Iterator[Finding]:
    """Check the Dask cluster of a fleet's shards: which programs may run code there, and the room of its workers."""
    from monitor_node.placement import RESOURCE, cluster_security, worker_command

    if (address := fleet.scheduler) is None:
        return
    use = f"use SITE/fleet/cluster: {CLUSTER_SETTINGS} for scheduler and workers, the folder as [fleet] identity"
    is_open = not address.startswith("tls://")
    if is_open and not _is_loopback(address.replace("//", "/")):
        found = f"no certificates: every program that reaches {address} runs code as the workers"
        yield Finding("cluster", found, f"{use}, with an address like tls://10.0.0.3:8786")
    try:
        if not is_open and (fleet.identity is None or _is_same(Path(fleet.identity) / CA, bus.ca)):
            yield Finding("cluster", "has the site's authority: every member of the site runs code as the workers", use)
        elif not is_open:
            yield _check_dates("cluster", read_certificate(Path(str(fleet.identity)) / CERTIFICATE), now)
        resources, lost_s = inspect_cluster(address, cluster_security(fleet, bus))
    except InputError as error:
        yield Finding("scheduler", f"{address} was not checked", str(error))
        return
    except OSError as error:
        cure = "start it, or correct scheduler or identity in [fleet]"
        yield Finding("scheduler", f"no way in at {address}: {one_line(error)}", cure)
        return
    shards, room = fleet.shards or 1, sum(item.get(RESOURCE, 0.0) for item in resources)
    found = f"{len(resources)} workers with room for {room:g} shards, for {shards}"
    yield Finding("workers", found, f"start more: {worker_command(address)}" if room < shards else "")
    if lost_s is None or lost_s > LOST_WITHIN_S:
        found = f"removed {'never' if lost_s is None else f'{lost_s:g} s'} after its last answer, and its shards wait"
        cure = f"set distributed.scheduler.worker-ttl to 2s, as {CLUSTER_SETTINGS} does, and restart the scheduler"
        yield Finding("lost worker", found, cure)


def _is_same(ca: Path, other: str | None) -> bool:
    return other is not None and read_certificate(ca) == read_certificate(Path(other))


def _check_disk(folder: Path, room_mb: float) -> Finding:
    while not folder.exists() and folder != folder.parent:  # it is made when needed
        folder = folder.parent
    free_mb = shutil.disk_usage(folder).free / 1e6
    found = f"{free_mb:,.0f} MB free at {folder.resolve()}"
    if free_mb < room_mb:
        return Finding("disk", found, f"make room for {room_mb:,.0f} MB, or set keep_mb in [recorder]")
    return Finding("disk", found)


def _check_publishing(bus: ZenohBus, config: BusConfig, plant: str, timeout_s: float) -> Iterator[Finding]:
    holder = certificate_holder(config)
    kinds = (keys.SAMPLE,) if holder is None else kinds_of(holder[1])
    if not kinds:
        yield Finding("heard", "this certificate is for reading and queries; it publishes nothing")
        return
    speaker = connect_now(config)
    try:
        refused = [kind for kind in kinds if not _is_received(speaker, bus, plant, kind, timeout_s)]
    finally:
        speaker.close()
    if refused:
        cure = "its rules know no such holder: call `certify` for the plant, and start the router with its router.json5"
        yield Finding("heard", f"messages published from here do not arrive: {', '.join(refused)}", cure)
    else:
        yield Finding("heard", f"messages published from here arrive: {', '.join(kinds)}")


def _is_received(speaker: ZenohBus, listener: ZenohBus, plant: str, kind: str, timeout_s: float) -> bool:
    heard = threading.Event()
    proof = Encoded(keys.key(plant, kind, "@doctor/proof"), b"heard", "text/plain")
    listener.subscribe(proof.key, lambda _: heard.set())
    until = time.monotonic() + timeout_s
    while not heard.is_set() and time.monotonic() < until:
        speaker.publish(proof)
        heard.wait(REPEAT_S)
    return heard.is_set()


class _NodeListener:
    """Subscriber to tokens and health of nodes of a plant, or of all with `*`, and the offsets of their clocks in s.

    Cached messages may be a minute old, so only live ones count. A delayed message makes a clock seem behind, so the
    largest offset is the best estimate. A clock behind by no more than a message's delay is observed further, until a
    better message arrives or the time is over.
    """

    def __init__(self, bus: ZenohBus, plant: str, timeout_s: float) -> None:
        self._plant, self.timeout_s = plant, timeout_s
        self.alive: set[tuple[str, str]] = set()  # by plant and node
        self.health: dict[tuple[str, str], tuple[Health, float]] = {}
        self.monitors = OtherMonitors("", lambda: ())
        self._done: set[tuple[str, str]] = set()
        self._changed = threading.Condition()
        bus.subscribe_liveliness(keys.all_keys(plant, keys.ALIVE), self._on_token)
        for tokens in (keys.monitor_token(plant, "*"), keys.FLEET_TOKENS):
            bus.subscribe_liveliness(tokens, self._on_monitor)
        bus.subscribe_uncached(keys.key(plant, keys.HEALTH, "*"), self._on_health)

    def wait(self) -> None:
        """Wait until all expected nodes have published their health, and their offsets are known."""
        expected = {(self._plant, node) for node in NODES}  # no node is of a plant `*`
        with self._changed:
            self._changed.wait_for(lambda: expected <= self._done & self.alive, self.timeout_s)

    def _on_token(self, key: str, is_alive: bool) -> None:
        topic = keys.parse(key)
        if topic is not None:
            with self._changed:
                (self.alive.add if is_alive else self.alive.discard)((topic.plant, topic.name))
                self._changed.notify_all()

    def _on_monitor(self, token: str, is_alive: bool) -> None:
        with self._changed:
            self.monitors.on_token(token, is_alive=is_alive)

    def _on_health(self, message: Encoded) -> None:
        topic = keys.parse(message.key)
        try:
            health = decode(message.payload, message.encoding)
        except DecodeError:
            return
        if topic is not None and isinstance(health, Health):
            node = topic.plant, topic.name
            with self._changed:
                offset_s = (health.time_ns - message.received_ns) / 1e9
                before = self.health.get(node)
                if before is not None:
                    offset_s = max(offset_s, before[1])
                if offset_s >= -MAX_OFFSET_S or (before is not None and offset_s < -self.timeout_s):
                    self._done.add(node)
                self.health[node] = health, offset_s
                self._changed.notify_all()


def _check_nodes(bus: ZenohBus, plant: str, timeout_s: float) -> Iterator[Finding]:
    listener = _NodeListener(bus, plant, timeout_s)
    listener.wait()
    alive = {node for of, node in listener.alive if of == plant}
    yield from _check_plant(listener, plant, [node for node in NODES if node != "plant" or "replay" not in alive])


def _check_all_nodes(bus: ZenohBus, timeout_s: float) -> Iterator[Finding]:
    """Check the nodes of all plants. Each plant has a monitor; the recorder for all is that of the plant `FLEET`."""
    listener = _NodeListener(bus, "*", timeout_s)
    listener.wait()
    plants = {plant for plant, _ in (*listener.alive, *listener.health)}
    for plant in sorted(plants):
        for finding in _check_plant(listener, plant, [] if plant == FLEET else ["monitor"]):
            if finding.cure:
                yield finding._replace(check=f"{finding.check} of {plant}")
    cure = "" if plants else "start them, or listen for longer by --timeout"
    yield Finding("plants", f"{len(plants - {FLEET})} with nodes", cure)


def _check_plant(listener: _NodeListener, plant: str, expected: list[str]) -> Iterator[Finding]:
    reports = {node: report for (of, node), report in listener.health.items() if of == plant}
    # a fleet's monitor shows the tokens of some of its plants only
    alive = reports.keys() | {node for of, node in listener.alive if of == plant}
    for node in (*expected, *sorted(alive - set(expected))):
        if node not in alive:
            cure = f"start it, and call doctor with the settings of {node} if it is running"
            yield Finding(node, f"is not there on {plant}", cure)
        elif node not in reports:
            if node not in NODES:
                yield Finding(node, "is alive")  # a replay and the diagnosis node publish no health
            else:
                cure = "call doctor with its settings; or listen for longer than its health_period_s by --timeout"
                yield Finding(node, f"is alive, and publishes no health within {listener.timeout_s:g} s", cure)
        else:
            yield _check_node(node, *reports[node])
    if (monitors := listener.monitors.count(plant)) > 1:
        found = f"{monitors} of them watch {plant}: every alarm is raised as often"
        yield Finding("monitors", found, "stop all but one")


def _check_node(node: str, health: Health, offset_s: float) -> Finding:
    found = f"{health.phase}, version {health.version}, its clock {offset_s:+.3f} s from this one"
    cures = [f"mend what it waits for: {health.waiting_for}"] if health.waiting_for else []
    if health.version != version():
        cures.append(f"install the same version as here, {version()}")
    if abs(offset_s) > MAX_OFFSET_S:
        cures.append("have both machines' clocks set by NTP, as with chrony")
    return Finding(node, found, "; ".join(cures))


def _is_loopback(endpoint: str) -> bool:
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
