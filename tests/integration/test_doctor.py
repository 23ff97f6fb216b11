"""`reactorwatch doctor` on deployments with one thing wrong: it names the thing, and nothing else is wrong."""

import datetime
import itertools
import json
import os
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import msgspec
import pytest

from reactorwatch import __version__
from reactorwatch.cli.doctor import NODES, Finding, run_checks
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Health
from reactorwatch.runtime.acl import access_control
from reactorwatch.runtime.bus_zenoh import ZenohBus, connect_now, router, router_from_file
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint
from reactorwatch.runtime.provisioning import make_site

from ..end_to_end.conftest import REACTORWATCH
from .site import WITHIN_S, Site, make, settings

SHORTLY_S = 0.3
"""For what never comes."""

A_WHILE_S = 3.0
"""For what never comes, beside what has to: if a busy machine does not bring that in time, the doctor looks again."""


def now() -> datetime.datetime:
    return datetime.datetime.now(datetime.UTC)


def health(node: str, age_s: float, version: str = __version__) -> Encoded:
    """Health of a node, so old."""
    time_ns = round((now().timestamp() - age_s) * 1e9)
    message = Health(time_ns=time_ns, node=node, version=version, phase="watching")
    return encode(Publication(keys.key("cstr", keys.HEALTH, node), message))


@contextmanager
def nodes(
    buses: dict[str, ZenohBus], late_s: Sequence[float] = (0.0,), version: str = __version__, every_s: float = 0.05
) -> Iterator[None]:
    """Nodes that are alive and say so again and again, so late one message after another."""
    stopped = threading.Event()

    def speak(node: str, bus: ZenohBus) -> None:
        bus.declare_token(keys.key("cstr", keys.ALIVE, node))
        lateness_s = itertools.cycle(late_s)
        while not stopped.wait(every_s):
            bus.publish(health(node, next(lateness_s), version))

    threads = [threading.Thread(target=speak, args=item) for item in buses.items()]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stopped.set()
        for thread in threads:
            thread.join()


def wrong(
    config: BusConfig, folder: Path, timeout_s: float = WITHIN_S, plant: str = "cstr", room_mb: float = 0.0
) -> dict[str, Finding]:
    """What is wrong, by check."""
    return {item.check: item for item in run_checks(config, plant, folder, room_mb, timeout_s, now()) if item.cure}


def wrong_of_what_is_there(config: BusConfig, folder: Path, there: set[str]) -> dict[str, Finding]:
    """What is wrong once nodes that are there have come through, beside one that is not, by check."""
    latest = time.monotonic() + WITHIN_S
    while set(found := wrong(config, folder, A_WHILE_S)) & there:
        assert time.monotonic() < latest, found
    return found


def test_nothing_is_wrong_with_a_site_where_all_is_well(site: Site, tmp_path: Path) -> None:
    with nodes({node: site.join(f"cstr/{node}") for node in NODES}):
        for who in ("plant", "monitor", "recorder", "operator", "engineer", "viewer"):
            assert wrong(settings(site.folder, f"cstr/{who}"), tmp_path) == {}


def test_nothing_is_wrong_on_loopback_without_certificates(tmp_path: Path) -> None:
    config = BusConfig(endpoint=free_endpoint())
    bus = router(config)
    speakers = {node: connect_now(config) for node in NODES}
    try:
        with nodes(speakers):
            assert wrong(config, tmp_path) == {}
    finally:
        for speaker in speakers.values():
            speaker.close()
        bus.close()


def test_no_node_receives_the_messages_of_the_doctor(site: Site, tmp_path: Path) -> None:
    heard: list[Encoded] = []
    recorder = site.join("cstr/recorder")
    recorder.subscribe("reactor/cstr/**", heard.append)
    plant = site.join("cstr/plant")
    with nodes({node: site.join(f"cstr/{node}") for node in NODES}):
        found = list(run_checks(settings(site.folder, "cstr/plant"), "cstr", tmp_path, 0.0, WITHIN_S, now()))
    assert Finding("heard", "messages published from here arrive: sample, fault") in found
    plant.publish(Encoded("reactor/cstr/sample/T", b"measured", ""))
    site.leave(plant)
    site.leave(recorder)
    of_nodes = {keys.key("cstr", keys.HEALTH, node) for node in NODES}
    assert [message.payload for message in heard if message.key not in of_nodes] == [b"measured"]


def test_a_missing_router_is_reported(tmp_path: Path) -> None:
    assert set(wrong(BusConfig(endpoint=free_endpoint()), tmp_path)) == {"router"}


def test_a_router_of_another_authority_is_reported(site: Site, tmp_path: Path) -> None:
    make(tmp_path / "foreign", site.endpoint)
    found = wrong(settings(tmp_path / "foreign", "cstr/plant"), tmp_path)
    assert set(found) == {"router"}
    assert "authority" in found["router"].cure


def test_an_open_bus_is_reported(tmp_path: Path) -> None:
    """The first check, before anything is called: the address is one set aside for documents."""
    found = next(iter(run_checks(BusConfig(endpoint="tcp/192.0.2.1:7447"), "cstr", tmp_path, 0.0, 0.0, now())))
    assert found.check == "certificate"
    assert "certify" in found.cure


@pytest.mark.parametrize(("days", "expected"), [(1.0, "valid until"), (-1.0, "expired")])
def test_a_certificate_that_is_or_will_soon_be_expired_is_reported(tmp_path: Path, days: float, expected: str) -> None:
    endpoint = make(tmp_path)
    shutil.rmtree(tmp_path / "cstr" / "viewer")
    make_site(tmp_path, ("cstr",), endpoint, endpoint, 10.0, now() + datetime.timedelta(days=days - 10.0))
    found = wrong(settings(tmp_path, "cstr/viewer"), tmp_path)
    assert expected in found["certificate"].found
    assert "certify" in found["certificate"].cure


def test_a_key_that_others_can_read_is_reported(tmp_path: Path) -> None:
    make(tmp_path)
    (tmp_path / "cstr" / "viewer" / "key.pem").chmod(0o644)
    assert "chmod 600" in wrong(settings(tmp_path, "cstr/viewer"), tmp_path)["private key"].cure


def test_a_key_of_another_certificate_is_reported(tmp_path: Path) -> None:
    make(tmp_path)
    (tmp_path / "cstr" / "viewer" / "key.pem").write_bytes((tmp_path / "cstr" / "plant" / "key.pem").read_bytes())
    assert "is not the key of" in wrong(settings(tmp_path, "cstr/viewer"), tmp_path)["identity"].found


def test_a_certificate_of_another_plant_is_reported(tmp_path: Path) -> None:
    make(tmp_path)
    assert "other.viewer" in wrong(settings(tmp_path, "other/viewer"), tmp_path)["identity"].found


def test_a_plant_that_the_router_has_no_rules_for_is_reported(tmp_path: Path) -> None:
    """As when it was not started again after the plant was added: it lets in, and lets nothing through."""
    make(tmp_path)
    file = tmp_path / "router" / "router.json5"
    rules = json.loads(file.read_text(encoding="utf-8"))
    file.write_text(json.dumps({**rules, "access_control": access_control(("cstr",))}), encoding="utf-8")
    bus = router_from_file(file)
    try:
        found = wrong(settings(tmp_path, "other/plant"), tmp_path, SHORTLY_S, plant="other")
        assert "sample, fault" in found["heard"].found
    finally:
        bus.close()


def test_a_missing_node_is_reported(site: Site, tmp_path: Path) -> None:
    with nodes({node: site.join(f"cstr/{node}") for node in ("plant", "monitor")}):
        found = wrong_of_what_is_there(settings(site.folder, "cstr/viewer"), tmp_path, {"plant", "monitor"})
    assert set(found) == {"recorder"}


def test_a_clock_offset_and_another_version_are_reported(site: Site, tmp_path: Path) -> None:
    others = {node: site.join(f"cstr/{node}") for node in ("plant", "recorder")}
    with nodes(others), nodes({"monitor": site.join("cstr/monitor")}, late_s=[3600.0], version="0.0.1"):
        found = wrong(settings(site.folder, "cstr/viewer"), tmp_path)
    assert set(found) == {"monitor"}
    assert "NTP" in found["monitor"].cure
    assert f"same version as here, {__version__}" in found["monitor"].cure
    assert "its clock -36" in found["monitor"].found


def test_messages_that_come_late_are_not_taken_for_a_clock_that_is_off(site: Site, tmp_path: Path) -> None:
    with nodes({node: site.join(f"cstr/{node}") for node in NODES}, late_s=[4.0, 3.0, 5.0, 0.0]):
        assert wrong(settings(site.folder, "cstr/viewer"), tmp_path) == {}


REMEMBERED_S = range(60, 0, -5)


@contextmanager
def nodes_of_a_minute(buses: dict[str, ZenohBus], late_s: float = 0.0) -> Iterator[None]:
    """Nodes that have said of themselves what they are, every 5 s for a minute, and say it again each second."""
    for node, bus in buses.items():
        for age_s in REMEMBERED_S:
            bus.publish(health(node, late_s + age_s))
    with nodes(buses, [late_s], every_s=1.0):
        yield


def test_a_message_published_a_minute_ago_is_not_taken_for_the_clock_of_its_node(site: Site, tmp_path: Path) -> None:
    """Publishers remember it, and subscribers ask for it: whatever the plant's speed, it is as old as it is."""
    with nodes_of_a_minute({node: site.join(f"cstr/{node}") for node in NODES}):
        assert wrong(settings(site.folder, "cstr/viewer"), tmp_path, 20.0) == {}


def test_a_clock_that_is_off_by_less_than_what_is_remembered_is_reported(site: Site, tmp_path: Path) -> None:
    others = {node: site.join(f"cstr/{node}") for node in ("plant", "recorder")}
    with nodes(others), nodes_of_a_minute({"monitor": site.join("cstr/monitor")}, late_s=20.0):
        found = wrong(settings(site.folder, "cstr/viewer"), tmp_path, 15.0)
    assert set(found) == {"monitor"}
    assert found["monitor"].found.partition("its clock ")[2].startswith(("-20.", "-21."))


def test_two_monitors_of_one_plant_are_reported(site: Site, tmp_path: Path) -> None:
    buses = {node: site.join(f"cstr/{node}") for node in NODES}
    other = site.join("cstr/monitor")
    with nodes(buses):
        buses["monitor"].declare_token(keys.monitor_token("cstr", "a"))
        assert wrong(settings(site.folder, "cstr/viewer"), tmp_path) == {}
        other.declare_token(keys.monitor_token("cstr", "b"))
        found = wrong(settings(site.folder, "cstr/viewer"), tmp_path)
    assert set(found) == {"monitors"}
    assert found["monitors"].found == "2 of them watch cstr: every alarm is raised as often"


def test_with_a_certificate_for_all_plants_the_nodes_of_each_are_checked(tmp_path: Path) -> None:
    with closing(Site(tmp_path / "site", ("cstr", "other", "*"))) as site:
        watched = {node: site.join("fleet/" + node) for node in ("monitor", "recorder")}
        with nodes({"plant": site.join("cstr/plant"), **watched}):
            for role in ("monitor", "recorder", "viewer"):
                config = settings(site.folder, f"fleet/{role}")
                assert wrong(config, tmp_path) == {}
                assert wrong(config, tmp_path, A_WHILE_S, plant="fleet") == {}
            other = site.join("other/plant")
            other.declare_token(keys.key("other", keys.ALIVE, "plant"))
            assert "monitor of other" in wrong(config, tmp_path, A_WHILE_S, plant="fleet")


def test_a_full_disk_is_reported(tmp_path: Path) -> None:
    found = wrong(BusConfig(endpoint=free_endpoint()), tmp_path / "not" / "made yet", room_mb=1e12)
    assert "make room" in found["disk"].cure


def doctor(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([REACTORWATCH, "doctor", *arguments], capture_output=True, text=True, check=False)


def test_the_command_ends_with_0_if_all_is_well(site: Site) -> None:
    with nodes({node: site.join(f"cstr/{node}") for node in NODES}):
        done = doctor("--config", str(site.folder / "cstr" / "viewer" / "settings.toml"), "--json")
    assert msgspec.json.decode(done.stdout)["ok"] is True
    assert done.returncode == 0


def test_the_command_ends_with_1_and_a_cure_if_something_is_wrong() -> None:
    done = doctor("--endpoint", free_endpoint())
    assert done.returncode == 1
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("WRONG")]
    assert line.startswith("WRONG  router: no way in at tcp/127.0.0.1:")
    assert "; start it" in line


@pytest.mark.parametrize("arguments", [["--config", "nowhere.toml"], ["--endpoint", "here"], ["--plant", "a/b"]])
def test_the_command_ends_with_2_and_one_line_if_it_was_asked_wrongly(arguments: list[str]) -> None:
    done = doctor(*arguments)
    assert done.returncode == 2
    assert done.stderr.startswith("reactorwatch: ")
    assert done.stderr.count(os.linesep) == 1
