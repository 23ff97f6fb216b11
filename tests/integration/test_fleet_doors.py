"""Certificates for all plants of a site: real sessions on loopback, against the router's settings of `certify`.

What is refused is refused in silence, so each test also shows the like that is let in, as in `test_doors`.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from monitor_node.config import MonitorConfig
from monitor_node.fleet import FleetConfig
from monitor_node.node import instance_token
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, encode_message
from reactorwatch.contract.messages_pb2 import AlarmCommand, CommandReply
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.start import claim_name

from .site import PLANTS, WITHIN_S, Site

ROLES = ("monitor", "recorder", "operator", "engineer", "viewer")
ALL = "reactor/*"


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    """A site of two plants with certificates of their own, and with certificates for all plants."""
    with closing(Site(tmp_path / "site", (*PLANTS, "*"))) as opened:
        yield opened


class Received:
    """Messages that a member receives on a key expression, by key and payload."""

    def __init__(self, site: Site, member: str, expression: str) -> None:
        self._messages, self._changed = list[tuple[str, bytes]](), threading.Condition()
        site.join(member).subscribe(expression, self._add)

    def _add(self, message: Encoded) -> None:
        with self._changed:
            self._messages.append((message.key.removeprefix("reactor/"), message.payload))
            self._changed.notify_all()

    def until(self, is_last: Callable[[list[tuple[str, bytes]]], bool]) -> list[tuple[str, bytes]]:
        with self._changed:
            assert self._changed.wait_for(lambda: is_last(self._messages), WITHIN_S), self._messages
            return list(self._messages)


def measured(plant: str) -> Encoded:
    return Encoded(keys.key(plant, keys.SAMPLE, "T"), plant.encode(), "")


def test_the_monitor_of_all_plants_reads_the_samples_of_each_at_once(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And not only when it asks the publishers for what it missed."""
    monkeypatch.setattr("reactorwatch.runtime.bus_zenoh.bus.LAST_QUERY_PERIOD_S", 10 * WITHIN_S)
    received = Received(site, "fleet/monitor", f"{ALL}/sample/**")
    for plant in PLANTS:
        site.join(f"{plant}/plant").publish(measured(plant))
    assert sorted(received.until(lambda found: len(found) == 2)) == [
        ("cstr/sample/T", b"cstr"),
        ("other/sample/T", b"other"),
    ]


def test_the_recorder_of_all_plants_receives_the_history_of_each(site: Site) -> None:
    early = {plant: Received(site, f"{plant}/viewer", f"reactor/{plant}/sample/**") for plant in PLANTS}
    for plant in PLANTS:
        site.join(f"{plant}/plant").publish(measured(plant))
        early[plant].until(bool)
    recorder, latest = site.join("fleet/recorder"), time.monotonic() + WITHIN_S
    while len(history := recorder.query_history(f"{ALL}/**")) < 2:
        assert time.monotonic() < latest, history
    assert sorted(message.payload for message in history) == [b"cstr", b"other"]


def test_the_monitor_of_all_plants_publishes_alarms_of_each_and_a_plant_s_viewer_sees_its_own(site: Site) -> None:
    viewers = {plant: Received(site, f"{plant}/viewer", f"reactor/{plant}/alarm/**") for plant in PLANTS}
    wide = Received(site, "other/viewer", f"{ALL}/alarm/**")
    fleet = Received(site, "fleet/viewer", f"{ALL}/alarm/**")
    monitor = site.join("fleet/monitor")
    for plant in PLANTS:
        monitor.publish(Encoded(keys.key(plant, keys.ALARM, "ewma/T"), plant.encode(), ""))
    own = {plant: (f"{plant}/alarm/ewma/T", plant.encode()) for plant in PLANTS}
    assert sorted(fleet.until(lambda found: len(found) == 2)) == sorted(own.values())
    for viewer in viewers.values():
        viewer.until(bool)
    site.close_readers()
    assert {plant: viewer.until(bool) for plant, viewer in viewers.items()} == {p: [own[p]] for p in PLANTS}
    assert wide.until(lambda _: True) == []


def test_no_certificate_for_all_plants_publishes_what_its_role_may_not(site: Site) -> None:
    """No samples for any, alarms for the monitor alone, those of the recorder for the recorder alone."""
    received = Received(site, "fleet/viewer", f"{ALL}/**")
    members = {role: site.join(f"fleet/{role}") for role in ROLES}
    kinds = ("sample/T", "alarm/ewma/T", "alarm/recording/disk")
    for role, member in members.items():
        for kind in kinds:
            member.publish(Encoded(f"reactor/cstr/{kind}", role.encode(), ""))
    site.leave(*members.values())
    site.join("cstr/plant").publish(measured("cstr"))
    found = received.until(lambda found: ("cstr/sample/T", b"cstr") in found)
    site.close_readers()
    assert sorted(found) == [
        ("cstr/alarm/ewma/T", b"monitor"),
        ("cstr/alarm/recording/disk", b"recorder"),
        ("cstr/sample/T", b"cstr"),
    ]


@pytest.mark.parametrize("monitor", ["fleet/monitor", "cstr/monitor"])
def test_operators_of_the_plant_and_of_all_plants_command_a_monitor_and_viewers_do_not(
    site: Site, monitor: str
) -> None:
    key = ("reactor/*" if monitor.startswith("fleet") else "reactor/cstr") + "/command/acknowledge"
    site.join(monitor).declare_queryable(key, lambda request: request.reply(CommandReply(accepted=True)))
    question = Encoded("reactor/cstr/command/acknowledge", *encode_message(AlarmCommand(alarm="a", by="Anna")))
    engineer = site.join("cstr/engineer")
    while not engineer.query(question, WITHIN_S):
        pass
    members = [f"{plant}/{role}" for plant in (*PLANTS, "fleet") for role in ("operator", "viewer")]
    answered = {member for member in members if site.join(member).query(question, WITHIN_S)}
    assert answered == {"cstr/operator", "fleet/operator"}


def test_monitors_of_all_plants_find_each_other_and_no_other_role_can_feign_one(site: Site) -> None:
    fleet = FleetConfig(plants=ALL, shard="2/5")
    own, feigned = (instance_token(MonitorConfig(), fleet) for _ in range(2))
    for member in ("cstr/monitor", "fleet/recorder", "fleet/viewer"):
        site.join(member).declare_token(feigned)
    monitor = site.join("fleet/monitor")
    assert claim_name(monitor, "monitor", own, StopSignal())
    monitor.declare_token(keys.key("cstr", keys.ALIVE, "monitor"))
    assert site.join("fleet/monitor").query_tokens(f"{own.rpartition('/')[0]}/*") == [own]
    assert site.join("cstr/viewer").query_tokens(keys.FLEET_TOKENS) == [own]
    assert site.join("cstr/viewer").query_tokens("reactor/cstr/alive/*") == ["reactor/cstr/alive/monitor"]
