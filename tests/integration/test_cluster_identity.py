"""The identity of a fleet's Dask cluster, and what `doctor` finds of it: a real scheduler and worker.

They have the settings that `certify` writes.
"""

import datetime
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from monitor_node.fleet import FleetConfig
from monitor_node.placement import cluster_security
from reactorwatch.cli.doctor import Finding, check_cluster
from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.http_pages import free_port
from reactorwatch.runtime.provisioning import make_site
from tests.cluster import Cluster

WITHIN_S = 60.0
distributed = pytest.importorskip("distributed", reason="Dask (reactorwatch[cluster]) is not installed")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cluster") / "site"
    make_site(folder, ("cstr", "*"), None, None, 90.0, datetime.datetime.now(datetime.UTC))
    return folder


@pytest.fixture(scope="module")
def cluster(site: Path) -> Iterator[Cluster]:
    """A scheduler and a worker that get no other options than those of any cluster."""
    settings = {"DASK_CONFIG": str(site / "fleet" / "cluster")}
    with closing(Cluster(site.parent, settings)) as running:
        running.address = running.address.replace("tcp:", "tls:")
        running.start_worker()
        yield running


def client(address: str, identity: Path | None, timeout_s: float) -> Any:
    security = None
    if identity is not None:
        fleet = FleetConfig(plants="reactor/*", scheduler=address, identity=str(identity))
        security = cluster_security(fleet, BusConfig())
    return distributed.Client(address, security=security, timeout=timeout_s, set_as_default=False)


def test_the_identity_of_the_cluster_runs_programs_on_its_workers(site: Path, cluster: Cluster) -> None:
    with client(cluster.address, site / "fleet" / "cluster", WITHIN_S) as connected:
        assert connected.submit(abs, -7, resources={"monitor": 1}).result(WITHIN_S) == 7
        (worker,) = connected.scheduler_info()["workers"]
        assert worker.startswith("tls://")


@pytest.mark.parametrize("member", ["fleet/monitor", "cstr/viewer", "router", "of another site"])
def test_no_other_certificate_of_the_site_reaches_the_cluster(
    site: Path, cluster: Cluster, tmp_path: Path, member: str
) -> None:
    with client(cluster.address, site / "fleet" / "cluster", WITHIN_S):  # it is there
        pass
    folder = site / member
    if member == "of another site":
        make_site(tmp_path, ("*",), None, None, 90.0, datetime.datetime.now(datetime.UTC))
        folder = tmp_path / "fleet" / "cluster"
    (tmp_path / "feigned").mkdir()
    for name in ("certificate.pem", "key.pem"):
        (tmp_path / "feigned" / name).write_bytes((folder / name).read_bytes())
    ca = (site / "fleet" / "cluster" / "ca.pem").read_bytes()  # so that it is not the client that refuses
    (tmp_path / "feigned" / "ca.pem").write_bytes(ca)
    with pytest.raises(OSError, match=r"SSL|TLS|timed out"):
        client(cluster.address, tmp_path / "feigned", 3.0)


def test_plain_tcp_does_not_reach_the_cluster(cluster: Cluster) -> None:
    with pytest.raises(OSError, match=r"reset by peer|timed out"):
        client(cluster.address.replace("tls:", "tcp:"), None, 3.0)


def wrong(bus: BusConfig, **settings: Any) -> dict[str, Finding]:
    """Findings of `doctor` that need a cure, by check."""
    fleet, now = FleetConfig(plants="reactor/*", **settings), datetime.datetime.now(datetime.UTC)
    return {finding.check: finding for finding in check_cluster(fleet, bus, now) if finding.cure}


def settings_of(site: Path, member: str) -> BusConfig:
    return section(BusConfig, "bus", read_settings(site / member / "settings.toml"), {})


def test_doctor_finds_nothing_wrong_with_a_cluster_and_its_identity(site: Path, cluster: Cluster) -> None:
    identity, bus = str(site / "fleet" / "cluster"), settings_of(site, "fleet/monitor")
    with client(cluster.address, Path(identity), WITHIN_S) as connected:
        connected.wait_for_workers(1, timeout=WITHIN_S)
    assert wrong(bus, scheduler=cluster.address, identity=identity, shards=1) == {}
    found = wrong(bus, scheduler=cluster.address, identity=identity, shards=2)
    assert found["workers"].found == "1 workers with room for 1 shards, for 2"
    assert "--resources monitor=1" in found["workers"].cure


def test_doctor_refuses_an_identity_that_every_member_of_the_site_could_have(site: Path) -> None:
    address = f"tls://127.0.0.1:{free_port()}"
    for identity in (None, str(site / "fleet" / "monitor")):
        found = wrong(settings_of(site, "fleet/monitor"), scheduler=address, identity=identity)
        assert "every member of the site" in found["cluster"].found
        assert "SITE/fleet/cluster" in found["cluster"].cure
        assert "no way in" in found["scheduler"].found


@pytest.mark.parametrize("host", ["192.0.2.1", "scheduler.example"])  # both are set aside for documents
def test_doctor_refuses_a_cluster_without_certificates_but_on_loopback(
    monkeypatch: pytest.MonkeyPatch, host: str
) -> None:
    monkeypatch.setattr("reactorwatch.cli.doctor.inspect_cluster", lambda *_: ([{"monitor": 1.0}], 5.0))
    found = wrong(BusConfig(), scheduler=f"tcp://{host}:8786")
    assert found.keys() == {"cluster"}
    assert "runs code as the workers" in found["cluster"].found
    assert wrong(BusConfig(), scheduler="tcp://127.0.0.1:8786") == {}
    assert "runs code" in wrong(BusConfig(), scheduler=f"tcp://{host}:8786", identity="cluster")["cluster"].found


def test_doctor_reports_workers_without_the_resource_and_a_scheduler_that_notices_losses_late(tmp_path: Path) -> None:
    with closing(Cluster(tmp_path, {"DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "5 minutes"})) as plain:
        with client(plain.address, None, WITHIN_S):  # it is there
            pass
        found = wrong(BusConfig(), scheduler=plain.address)
    assert found.keys() == {"workers", "lost worker"}
    assert found["workers"].found == "0 workers with room for 0 shards, for 1"
    assert found["lost worker"].found == "removed 300 s after its last answer, and its shards wait"


def test_doctor_states_how_to_install_dask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    found = wrong(BusConfig(), scheduler="tcp://127.0.0.1:8786")
    assert found.keys() == {"scheduler"}
    assert "pip install 'reactorwatch[cluster]'" in found["scheduler"].cure
