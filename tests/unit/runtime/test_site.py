"""A site on disk: one authority for good, folders that are half made are completed, bad names get one line."""

import datetime
import json
import shutil
import stat
import tomllib
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.x509.oid import ExtendedKeyUsageOID
from cryptography.x509.verification import PolicyBuilder, Store

from reactorwatch.errors import InputError
from reactorwatch.runtime.acl import ROLES, access_control, parse_common_name
from reactorwatch.runtime.certificates import read_certificate, read_common_name, read_key
from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.provisioning import MAX_PLANT_NAME, make_site

NOW = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
DAY = datetime.timedelta(days=1)
PEM = ("ca.pem", "certificate.pem", "key.pem")
ENDPOINT, LISTEN = "tls/bus.example:7447", "tls/0.0.0.0:7447"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "site"
    make_site(folder, ("a",), ENDPOINT, LISTEN, 90.0, NOW)
    return folder


@pytest.fixture
def site(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "site"))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def rules(site: Path) -> dict[str, object]:
    found: dict[str, object] = json.loads((site / "router" / "router.json5").read_text(encoding="utf-8"))
    return found


def check_whole(site: Path) -> None:
    """Each folder holds a certificate of the authority with its key, and settings that are taken."""
    ca = read_certificate(site / "authority" / "ca.pem")
    for folder in (site / "router", *(site / "a" / role.name for role in ROLES)):
        certificate = read_certificate(folder / "certificate.pem")
        certificate.verify_directly_issued_by(ca)
        assert read_key(folder / "key.pem").public_key() == certificate.public_key()
        assert (folder / "ca.pem").read_bytes() == (site / "authority" / "ca.pem").read_bytes()
        assert list(folder.glob(".*")) == []
    for role in ROLES:
        assert (
            section(BusConfig, "bus", read_settings(site / "a" / role.name / "settings.toml"), {}).endpoint == ENDPOINT
        )


def test_what_is_complete_stays_as_it_is(site: Path) -> None:
    before = contents(site)
    assert make_site(site, (), None, None, 90.0, NOW) == []
    assert contents(site) == before


@pytest.mark.parametrize("missing", ["authority", "authority/key.pem"])
def test_without_its_authority_nothing_is_made_or_changed(site: Path, missing: str) -> None:
    path = site / missing
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    before = contents(site)
    with pytest.raises(InputError, match=r"authority is not there.*put that folder back") as caught:
        make_site(site, ("b",), ENDPOINT, LISTEN, 90.0, NOW)
    assert "\n" not in str(caught.value)
    assert contents(site) == before


def test_without_its_notes_the_addresses_have_to_be_given(site: Path) -> None:
    (site / "authority" / "site.json").unlink()
    with pytest.raises(InputError, match="give --endpoint and --listen"):
        make_site(site, (), ENDPOINT, None, 90.0, NOW)
    make_site(site, (), ENDPOINT, LISTEN, 90.0, NOW)
    assert rules(site)["listen"]["endpoints"] == [LISTEN]  # type: ignore[index]


@pytest.mark.parametrize("endpoint", [None, ENDPOINT])
def test_the_router_keeps_its_endpoint(site: Path, endpoint: str | None) -> None:
    make_site(site, ("b",), endpoint, None, 90.0, NOW)
    assert rules(site)["listen"]["endpoints"] == [LISTEN]  # type: ignore[index]


DAMAGES = [
    *((folder, file, "missing") for folder in ("router", "a/monitor", "a/viewer") for file in ("ca.pem", "key.pem")),
    *((folder, "settings.toml", "missing") for folder in ("a/monitor", "a/viewer")),
    *(
        (folder, file, damage)
        for folder in ("router", "a/monitor", "a/viewer")
        for file in ("certificate.pem", "key.pem")
        for damage in ("empty", "cut", "of another")
    ),
    *((folder, "certificate.pem", "missing") for folder in ("router", "a/monitor", "a/viewer")),
]


@pytest.mark.parametrize(("folder", "file", "damage"), DAMAGES)
def test_a_half_made_folder_is_completed(site: Path, folder: str, file: str, damage: str) -> None:
    path = site / folder / file
    if damage == "missing":
        path.unlink()
    elif damage == "of another":
        shutil.copy(site / "a" / "operator" / file, path)
    else:
        path.write_bytes(path.read_bytes()[:100] if damage == "cut" else b"")
    assert make_site(site, (), None, None, 90.0, NOW) == [site / folder]
    check_whole(site)
    assert make_site(site, (), None, None, 90.0, NOW) == []


def test_what_was_added_to_settings_stays(site: Path) -> None:
    settings = site / "a" / "monitor" / "settings.toml"
    settings.write_text(settings.read_text() + "\n[log]\nformat = 'json'\n", encoding="utf-8")
    (settings.parent / "key.pem").unlink()
    make_site(site, (), None, None, 90.0, NOW)
    assert read_settings(settings)["log"] == {"format": "json"}


def test_a_new_site_whose_authority_is_half_made_is_made(tmp_path: Path) -> None:
    (tmp_path / "authority").mkdir()
    (tmp_path / "authority" / "key.pem").touch()
    make_site(tmp_path, ("a",), ENDPOINT, None, 90.0, NOW)
    check_whole(tmp_path)


def test_the_last_plant_that_is_removed_stays_removed(site: Path) -> None:
    shutil.rmtree(site / "a")
    assert make_site(site, (), None, None, 90.0, NOW) == []
    assert rules(site)["access_control"] == access_control(())
    assert sorted(path.name for path in site.iterdir()) == ["authority", "router"]


@pytest.mark.parametrize(
    ("plants", "endpoint", "listen"),
    [
        *((("a" * length,), ENDPOINT, None) for length in (MAX_PLANT_NAME + 1, 64, 65)),
        *(((name,), ENDPOINT, None) for name in ("ü", "a/b", "", "a b", "a\n", '"', "authority", "fleet", "**", "..")),
        *((("a",), address, None) for address in ("tls/ü:7447", 'tls/a":7447', "tls/a b:1", "tls/a:0", "tls/a:65536")),
        *((("a",), address, None) for address in ("tls/a\n:1", "tls/[::1:1", "tls/:1", "tls//:1", "tls/a:x", "x")),
        (("a",), ENDPOINT, "tls/'\"':7447"),
    ],
)
def test_a_name_or_address_that_cannot_be_gets_one_line_and_leaves_nothing(
    tmp_path: Path, plants: tuple[str, ...], endpoint: str, listen: str | None
) -> None:
    with pytest.raises(InputError) as caught:
        make_site(tmp_path / "site", plants, endpoint, listen, 90.0, NOW)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize("days", [float("nan"), 0.0, -1.0, 1e9])
def test_days_that_cannot_be_get_one_line(tmp_path: Path, days: float) -> None:
    with pytest.raises(InputError, match="--days must be"):
        make_site(tmp_path / "site", ("a",), ENDPOINT, None, days, NOW)


@pytest.mark.parametrize("plant", ["a" * MAX_PLANT_NAME, "A.b-c_1", "0"])
@pytest.mark.parametrize("endpoint", ["tls/[::1]:7447", "tls/bus_1.example:1"])
def test_settings_are_toml_with_the_names_as_given(tmp_path: Path, plant: str, endpoint: str) -> None:
    make_site(tmp_path, (plant,), endpoint, None, 90.0, NOW)
    make_site(tmp_path, (), None, None, 90.0, NOW, revoke=[f"{plant}/recorder"])  # whose name is the longest
    tables = tomllib.loads((tmp_path / plant / "recorder" / "settings.toml").read_text(encoding="utf-8"))
    assert (tables["bus"]["endpoint"], tables["plant"]["name"]) == (endpoint, plant)


def test_a_folder_that_is_no_plants_is_named(site: Path) -> None:
    (site / "a copy" / "monitor").mkdir(parents=True)
    with pytest.raises(InputError, match="a copy: is no plant's folder; move it out"):
        make_site(site, (), None, None, 90.0, NOW)


def test_certificates_are_renewed_before_they_end_and_keep_their_names(site: Path) -> None:
    later = NOW + 70 * DAY
    shutil.rmtree(site / "a" / "viewer")
    make_site(site, (), None, None, 365.0, later)  # one that has not to be renewed
    before = contents(site)
    renewed = make_site(site, (), None, None, 365.0, later, renew_days=30.0)
    assert renewed == [site / "router", *(site / "a" / role.name for role in ROLES if role.name != "viewer")]
    assert contents(site)["router/router.json5"] == before["router/router.json5"]
    for folder in renewed:
        assert read_certificate(folder / "certificate.pem").not_valid_after_utc == later + 365 * DAY
    router = read_certificate(site / "router" / "certificate.pem")
    store = Store([read_certificate(site / "authority" / "ca.pem")])
    assert (
        PolicyBuilder()
        .store(store)
        .time(later + DAY)
        .build_server_verifier(x509.DNSName("bus.example"))
        .verify(router, [])
    )
    assert make_site(site, (), None, None, 365.0, later, renew_days=30.0) == []


def test_a_revoked_certificate_is_on_the_routers_list_and_its_holder_has_another(site: Path) -> None:
    names = []
    for _ in range(2):
        names.append(read_common_name(read_certificate(site / "a" / "monitor" / "certificate.pem")))
        assert make_site(site, (), None, None, 90.0, NOW, revoke=["a/monitor"]) == [site / "a" / "monitor"]
    now = read_common_name(read_certificate(site / "a" / "monitor" / "certificate.pem"))
    assert len({now, *names}) == 3
    assert parse_common_name(now) == parse_common_name("a.monitor")
    make_site(site, ("b",), None, None, 90.0, NOW)
    subjects = {item["id"]: item["cert_common_names"] for item in rules(site)["access_control"]["subjects"]}  # type: ignore[index]
    assert (subjects["a.monitor"], subjects["revoked"]) == ([now], names)


@pytest.mark.parametrize("holder", ["a", "a/nobody", "b/monitor", "router", "a/monitor/x"])
def test_what_is_no_holder_cannot_be_revoked(site: Path, holder: str) -> None:
    before = contents(site)
    with pytest.raises(InputError, match="is no PLANT/ROLE of this site"):
        make_site(site, (), None, None, 90.0, NOW, revoke=[holder])
    assert contents(site) == before


def test_members_for_all_plants_are_kept_and_revoked_like_those_of_a_plant(site: Path) -> None:
    members = [site / "fleet" / role.name for role in ROLES if role.name != "plant"]
    assert make_site(site, ("*",), None, None, 90.0, NOW) == [*members, site / "fleet" / "cluster"]
    before = contents(site)
    assert make_site(site, (), None, None, 90.0, NOW) == []
    assert contents(site) == before
    assert rules(site)["access_control"] == access_control(("a", "fleet"))
    names = {read_common_name(read_certificate(member / "certificate.pem")) for member in members}
    assert names == {f"@fleet.{member.name}" for member in members}
    tables = read_settings(site / "fleet" / "monitor" / "settings.toml")
    assert tables["fleet"]["plants"] == "reactor/*"
    assert Path(tables["fleet"]["identity"]).samefile(site / "fleet" / "cluster")
    assert tables["recorder"]["key_expression"] == "reactor/*/**"
    assert make_site(site, (), None, None, 90.0, NOW, revoke=["fleet/monitor"]) == [site / "fleet" / "monitor"]
    revoked = next(item for item in rules(site)["access_control"]["subjects"] if item["id"] == "revoked")  # type: ignore[index]
    assert revoked["cert_common_names"] == ["@fleet.monitor"]


def test_a_cluster_has_an_authority_of_its_own_that_signs_nothing_else(site: Path) -> None:
    make_site(site, ("*",), None, None, 90.0, NOW)
    cluster = site / "fleet" / "cluster"
    ca, certificate = read_certificate(cluster / "ca.pem"), read_certificate(cluster / "certificate.pem")
    certificate.verify_directly_issued_by(ca)
    assert read_key(cluster / "key.pem").public_key() == certificate.public_key() != ca.public_key()
    assert ca.public_key() not in [read_key(path).public_key() for path in site.rglob("key.pem")]  # it was not kept
    for member in site.glob("*/*/certificate.pem"):
        if member.parent != cluster:
            with pytest.raises((ValueError, InvalidSignature)):
                read_certificate(member).verify_directly_issued_by(ca)
    usage = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert set(usage) == {ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH}
    for name in ("key.pem", "cluster.yaml"):
        assert stat.S_IMODE((cluster / name).stat().st_mode) == 0o600


def test_the_identity_of_a_cluster_is_renewed_as_a_whole_and_completed_when_damaged(site: Path) -> None:
    make_site(site, ("*",), None, None, 90.0, NOW)
    cluster, later = site / "fleet" / "cluster", NOW + 70 * DAY
    before = contents(cluster)
    assert make_site(site, (), None, None, 365.0, later) == []
    (cluster / "cluster.yaml").write_bytes(b"")
    assert make_site(site, (), None, None, 365.0, later) == [cluster]
    assert contents(cluster) == before
    for missing in ("", "key.pem", "ca.pem"):
        if missing:
            (cluster / missing).unlink()
        assert cluster in make_site(site, (), None, None, 365.0, later, renew_days=30.0)
        renewed = contents(cluster)
        assert not set(renewed.values()) & set(before.values())
        assert all(json.dumps(renewed[name].decode()).encode() in renewed["cluster.yaml"] for name in PEM)
        before = renewed
    certificate = read_certificate(cluster / "certificate.pem")
    assert certificate.not_valid_after_utc == later + 365 * DAY


def test_a_plant_that_an_older_version_called_fleet_is_refused_in_one_line(site: Path) -> None:
    (site / "a").rename(site / "fleet")
    before = contents(site)
    with pytest.raises(InputError, match=r"fleet/plant: .* name this plant otherwise"):
        make_site(site, (), None, None, 90.0, NOW)
    assert contents(site) == before


def test_a_site_whose_authority_expired_reports_it(site: Path) -> None:
    with pytest.raises(InputError, match="the authority's certificate ended on 2035"):
        make_site(site, (), None, None, 90.0, NOW + 3651 * DAY, renew_days=30.0)
