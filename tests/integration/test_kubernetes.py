"""The Kubernetes manifests, without a cluster: the commands and probes of the pods do their work past a router."""

import re
import subprocess
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from monitor_node.fleet import shard_of
from reactorwatch.contract import keys
from reactorwatch.runtime.bus_zenoh import router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import free_endpoint
from recorder.files.recording import Recording
from tests.manifests import PLAIN, SECURE, Manifest, container, environments, workloads

from .compose import SHARDS, WATCHED, Services, plant_beside, run_nodes
from .site import Site

NODES = ("recorder", "monitor", "plant")
SETTINGS = "/etc/reactorwatch/settings.toml"


def as_service(workload: Manifest, environment: Mapping[str, str]) -> dict[str, Any]:
    """A pod's container with its variables in their places, in the form of a compose file's service."""
    own = container(workload)
    command = [re.sub(r"\$\((\w+)\)", lambda found: environment[found[1]], word) for word in own["args"]]
    check = own["readinessProbe"]["exec"]["command"]
    assert not any("$(" in word for word in check), "probes know only variables with a value in the manifest"
    if check[0] == "sh":  # the shell says what it would execute
        assert check[2].startswith("exec ")
        shown = [*check[:2], check[2].replace("exec", "echo", 1)]
        check = subprocess.run(shown, env=environment, check=True, capture_output=True, text=True).stdout.split()
    return {"command": command, "healthcheck": {"test": ["CMD", *check]}}


def services_of(folder: Path) -> Services:
    """Recorder and the monitor that has the plant `cstr`, as services."""
    found = workloads(folder)
    environment = environments(found["monitor"])[shard_of("cstr", SHARDS) - 1]
    return {"recorder": as_service(found["recorder"], {}), "monitor": as_service(found["monitor"], environment)}


def mount_secret(source: Path, target: Path) -> str:
    """Files of a folder as a kubelet mounts them, by links, readable by the group; returns that of the settings."""
    data = target / "..2026_11_27"
    data.mkdir(parents=True)
    for file in source.iterdir():
        (data / file.name).write_bytes(file.read_bytes())
        (data / file.name).chmod(0o440)
        (target / file.name).symlink_to(Path("..data") / file.name)
    (target / "..data").symlink_to(data.name)
    return str(target / Path(SETTINGS).name)


def recorded_kinds(folder: Path) -> set[str]:
    (file,) = folder.glob("fleet-*.mcap")
    return {entry.key.split("/")[2] for entry in Recording(file).messages() if entry.key.split("/")[1] == "cstr"}


def test_the_commands_and_probes_work(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    outside = {"tcp/router:7447": endpoint, "/recordings": str(tmp_path), "/state": str(tmp_path)}
    services = {**services_of(PLAIN), "plant": plant_beside("--endpoint", endpoint)}
    with closing(router(BusConfig(endpoint=endpoint))) as bus:
        run_nodes(services, bus, lambda _node: outside, NODES, WATCHED)
    assert {keys.SAMPLE, keys.HEALTH} <= recorded_kinds(tmp_path)
    assert (tmp_path / "cstr.state").is_file()


@pytest.mark.slow
def test_the_commands_and_probes_work_with_certificates(tmp_path: Path) -> None:
    with closing(Site(tmp_path / "site", ("cstr", "*"))) as site:
        settings = {node: mount_secret(site.folder / "fleet" / node, tmp_path / node) for node in NODES[:2]}
        plant = plant_beside("--config", str(site.folder / "cstr" / "plant" / "settings.toml"))
        viewer = site.join("fleet/viewer")
        run_nodes(
            {**services_of(SECURE), "plant": plant},
            viewer,
            lambda node: {SETTINGS: settings.get(node, ""), "/recordings": str(tmp_path), "/state": str(tmp_path)},
            NODES,
            WATCHED,
        )
    assert {keys.SAMPLE, keys.HEALTH} <= recorded_kinds(tmp_path)
    assert (tmp_path / "cstr.state").is_file()
