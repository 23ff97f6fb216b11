"""The compose file with certificates, without an engine: its commands work past a router that keeps the rules."""

import re
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from reactorwatch.contract import keys
from reactorwatch.runtime.bus_zenoh import connect
from reactorwatch.runtime.event_loop import StopSignal
from recorder.files.recording import Recording

from .compose import NODES, SECURE, Services, run_nodes, services_of
from .site import Site, settings


@pytest.fixture(scope="module")
def services() -> Services:
    return services_of(SECURE)


def identity(service: dict[str, Any]) -> str:
    """The folder of the site that a service has as /identity."""
    (source,) = [mount.split(":")[0] for mount in service["volumes"] if mount.split(":")[1] == "/identity"]
    return str(source).removeprefix("./site/")


@pytest.mark.slow
def test_every_service_s_command_and_health_check_work(services: Services, tmp_path: Path) -> None:
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    with closing(Site(tmp_path / "site")) as site:
        viewer = connect(settings(site.folder, "cstr/viewer"), "viewer", StopSignal())
        assert viewer is not None

        def outside(node: str) -> dict[str, str]:
            return {
                "/identity/settings.toml": str(site.folder / identity(services[node]) / "settings.toml"),
                "/recordings": str(recordings),
                "/state": str(recordings),
            }

        with closing(viewer):
            run_nodes(services, viewer, outside)
    (file,) = recordings.glob("cstr-*.mcap")
    kinds = {entry.key.split("/")[2] for entry in Recording(file).messages()}
    assert {keys.SAMPLE, keys.ESTIMATE, keys.HEALTH} <= kinds


def test_each_service_has_its_own_identity_and_none_the_authority(services: Services) -> None:
    identities = {name: identity(service) for name, service in services.items()}
    assert identities == {"router": "router", **{node: f"cstr/{node}" for node in NODES}}
    for service in services.values():
        mounts = [mount for mount in service["volumes"] if mount.startswith("./site")]
        assert len(mounts) == 1
        assert mounts[0].endswith(":ro")


def test_nothing_goes_by_plain_tcp(services: Services) -> None:
    for service in services.values():
        assert not re.search(r"tcp/", " ".join(service["command"]))


def test_the_router_s_settings_are_found_where_it_works(services: Services) -> None:
    """Zenoh reads files relative to the folder that it works in, and the settings name them without one."""
    router = services["router"]
    assert router["working_dir"] == "/identity"
    assert router["command"] == ["--config", "/identity/router.json5"]
