"""A revoked certificate grants nothing, and its owner continues with the new one; a site may have no plant."""

import datetime
import shutil
from contextlib import closing
from pathlib import Path

from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.bus_zenoh import connect, router_from_file
from reactorwatch.runtime.provisioning import make_site

from .site import OneAttempt, Site, make, settings

SAMPLE = "reactor/cstr/sample/T"


def renewed(folder: Path, **options: object) -> None:
    make_site(folder, (), None, None, 90.0, datetime.datetime.now(datetime.UTC), **options)  # type: ignore[arg-type]


class Revoking(Site):
    """A site whose plant's certificate was stolen and is revoked before its router starts again."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.router.close()
        shutil.copytree(folder / "cstr" / "plant", folder.parent / "stolen")
        renewed(folder, revoke=("cstr/plant",))
        self.router = router_from_file(folder / "router" / "router.json5")
        self.router.subscribe(SAMPLE, self._on_message)


def test_a_revoked_certificate_publishes_nothing_and_the_new_one_does(tmp_path: Path) -> None:
    with closing(Revoking(tmp_path / "site")) as site:
        stolen = connect(settings(tmp_path, "stolen"), "thief", OneAttempt())
        if stolen is not None:
            stolen.publish(Encoded(SAMPLE, b"forged", ""))
            stolen.close()
        site.join("cstr/plant").publish(Encoded(SAMPLE, b"measured", ""))
        received = site.received_until(lambda message: message.payload == b"measured")
        assert [message.payload for message in received] == [b"measured"]


def test_a_revoked_certificate_reads_nothing(tmp_path: Path) -> None:
    with closing(Revoking(tmp_path / "site")) as site:
        received: dict[str, list[bytes]] = {"stolen": [], "viewer": []}
        stolen = connect(settings(tmp_path, "stolen"), "thief", OneAttempt())
        viewer = site.join("cstr/viewer")
        plant = site.join("cstr/plant")
        if stolen is not None:
            stolen.subscribe(SAMPLE, lambda message: received["stolen"].append(message.payload))
        viewer.subscribe(SAMPLE, lambda message: received["viewer"].append(message.payload))
        number = 0
        while not received["viewer"]:
            number += 1
            plant.publish(Encoded(SAMPLE, str(number).encode(), ""))
            plant.query(Encoded("reactorwatch/nobody", b"", ""), 1.0)  # comes back when what was before it is through
        if stolen is not None:
            stolen.close()
        assert received["stolen"] == []


def test_a_site_without_a_plant_has_a_router_that_lets_nothing_pass(tmp_path: Path) -> None:
    site = tmp_path / "site"
    make(site)
    shutil.copytree(site / "cstr" / "plant", tmp_path / "old")
    for plant in ("cstr", "other"):
        shutil.rmtree(site / plant)
    renewed(site)
    with closing(router_from_file(site / "router" / "router.json5")) as router:
        received: list[bytes] = []
        router.subscribe(SAMPLE, lambda message: received.append(message.payload))
        bus = connect(settings(tmp_path, "old"), "plant", OneAttempt())
        if bus is not None:
            bus.publish(Encoded(SAMPLE, b"x", ""))
            bus.close()
        assert received == []
