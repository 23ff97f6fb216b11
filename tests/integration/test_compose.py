"""The compose files, without an engine: every service's own command does its work against a router on loopback."""

import re
import shutil
import subprocess
from contextlib import closing
from pathlib import Path

import pytest
import yaml

from monitor_node.fleet import shard_of
from reactorwatch.runtime.bus_zenoh import router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint

from .compose import FLEET, NODES, PLAIN, SECURE, SHARDS, WATCHED, plant_beside, run_nodes, services_of

MONITORS = [f"monitor-{number}" for number in range(1, SHARDS + 1)]
SERVICES = {PLAIN: {"router", *NODES}, SECURE: {"router", *NODES}, FLEET: {"router", "recorder", *MONITORS}}

every_file = pytest.mark.parametrize("file", SERVICES, ids=lambda file: file.name)


def test_every_service_s_command_and_health_check_work(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    outside = {"tcp/router:7447": endpoint, "/recordings": str(tmp_path), "/state": str(tmp_path)}
    with closing(router(BusConfig(endpoint=endpoint))) as bus:
        run_nodes(services_of(PLAIN), bus, lambda _node: outside)
    assert len(list(tmp_path.glob("cstr-*.mcap"))) == 1
    assert (tmp_path / "monitor.state").is_file()


def test_the_commands_and_health_checks_of_a_fleet_s_services_work(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    outside = {"tcp/router:7447": endpoint, "/recordings": str(tmp_path), "/state": str(tmp_path)}
    services = {**services_of(FLEET), "plant": plant_beside("--endpoint", endpoint)}
    nodes = ("recorder", f"monitor-{shard_of('cstr', SHARDS)}", "plant")
    with closing(router(BusConfig(endpoint=endpoint))) as bus:
        run_nodes(services, bus, lambda _node: outside, nodes, WATCHED)
    assert len(list(tmp_path.glob("fleet-*.mcap"))) == 1
    assert (tmp_path / "cstr.state").is_file()


@every_file
def test_every_service_is_watched_and_comes_back(file: Path) -> None:
    services = services_of(file)
    assert set(services) == SERVICES[file]
    for name, service in services.items():
        assert service["restart"] == "unless-stopped", name
        assert service["healthcheck"]["test"], name


@pytest.mark.parametrize("file", [PLAIN, FLEET], ids=lambda file: file.name)
def test_the_recordings_and_what_was_learned_outlive_the_containers(file: Path) -> None:
    volumes = []
    for node in SERVICES[file] - {"router", "plant"}:
        service = services_of(file)[node]
        (mount,) = [mount for mount in service["volumes"] if not mount.startswith("cache:")]
        volume, target = mount.split(":")
        volumes.append(volume)
        assert volume in yaml.safe_load(file.read_text(encoding="utf-8"))["volumes"]
        assert target in service["command"]
        assert f" {target}" in (PLAIN.parent / "Dockerfile").read_text(encoding="utf-8"), "it would belong to root"
    assert len(set(volumes)) == len(volumes), "two services would write to one"


def test_each_monitor_of_a_fleet_has_a_shard_and_is_checked_for_it() -> None:
    for number, name in enumerate(MONITORS, start=1):
        service = services_of(FLEET)[name]
        command, check = service["command"], service["healthcheck"]["test"]
        assert command[command.index("--shard") + 1] == check[check.index("--check") + 1] == f"{number}/{SHARDS}"


@every_file
def test_the_router_is_open_on_loopback_only(file: Path) -> None:
    for service in services_of(file).values():
        for port in service.get("ports", []):
            assert port.startswith("127.0.0.1:")


@every_file
def test_docker_compose_accepts_the_file(file: Path) -> None:
    program = shutil.which("docker-compose")
    if program is None:
        pytest.skip("docker-compose is not installed")
    subprocess.run([program, "-f", str(file), "config", "-q"], check=True)


@every_file
def test_every_service_is_locked_down_and_limited(file: Path) -> None:
    for name, service in services_of(file).items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert re.fullmatch(r"\d+[mg]", service["mem_limit"]), name
        assert service["pids_limit"] > 0, name
        assert "cap_add" not in service, name
        assert not service.get("privileged"), name


@every_file
def test_what_a_service_writes_is_on_a_volume(file: Path) -> None:
    """The root is read-only."""
    for name, service in services_of(file).items():
        mounted = [mount.split(":")[1] for mount in service.get("volumes", []) if not mount.endswith(":ro")]
        command = service["command"]
        written = [command[command.index(option) + 1] for option in ("--out", "--state") if option in command]
        compiled = [] if name == "router" else ["/home/reactorwatch/.cache"]
        assert {*written, *compiled} <= set(mounted), name


@every_file
def test_images_have_versions(file: Path) -> None:
    for name, service in services_of(file).items():
        assert re.search(r":\d+\.\d+\.\d+(\.dev\d+)?(@sha256:[0-9a-f]{64})?$", service["image"]), name
