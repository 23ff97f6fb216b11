"""The identity of a fleet's Dask cluster: a real scheduler and worker with the settings that `certify` writes."""

import datetime
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from monitor_node.fleet import FleetConfig
from monitor_node.placement import cluster_security
from reactorwatch.runtime.config import BusConfig
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
