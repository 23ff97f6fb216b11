"""The certificates of a site, judged by cryptography's own verifier and by what is on the disk."""

import datetime
import json
import os
import shutil
import stat
import tomllib
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID
from cryptography.x509.verification import PolicyBuilder, Store, VerificationError

from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.runtime.acl import ROLES, access_control
from reactorwatch.runtime.certificates import (
    Identity,
    issue,
    make_authority,
    read_certificate,
    read_common_name,
    read_key,
)
from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.provisioning import make_site

NOW = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
DAY = datetime.timedelta(days=1)
ENDPOINT = "tls/bus.example:7447"


@pytest.fixture(scope="module")
def ca() -> Identity:
    return make_authority("site", NOW, 100.0)


def policy(ca: Identity, days: float = 1.0) -> PolicyBuilder:
    return PolicyBuilder().store(Store([ca.certificate])).time(NOW + days * DAY)


def test_a_router_s_certificate_is_valid_for_its_host_and_for_no_other(ca: Identity) -> None:
    router = issue(ca, "router", NOW, 10.0, ("bus.example", "127.0.0.1"))
    assert policy(ca).build_server_verifier(x509.DNSName("bus.example")).verify(router.certificate, [])
    with pytest.raises(VerificationError):
        policy(ca).build_server_verifier(x509.DNSName("other.example")).verify(router.certificate, [])


@pytest.mark.parametrize("days", [-1.0, 11.0])
def test_a_certificate_is_valid_from_now_on_and_so_long(ca: Identity, days: float) -> None:
    router = issue(ca, "router", NOW, 10.0, ("bus.example",))
    with pytest.raises(VerificationError):
        policy(ca, days).build_server_verifier(x509.DNSName("bus.example")).verify(router.certificate, [])


def test_a_certificate_does_not_outlive_its_authority(ca: Identity) -> None:
    assert issue(ca, "a.viewer", NOW, 1000.0).certificate.not_valid_after_utc == ca.certificate.not_valid_after_utc


def test_a_role_that_only_connects_has_a_client_certificate_by_its_name(ca: Identity) -> None:
    viewer = issue(ca, "a.viewer", NOW, 10.0).certificate
    usage = viewer.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(usage) == [ExtendedKeyUsageOID.CLIENT_AUTH]
    assert read_common_name(viewer) == "a.viewer"


def test_a_folder_holds_a_certificate_with_its_key_and_the_settings_to_use_them(tmp_path: Path) -> None:
    make_site(tmp_path, ("a",), ENDPOINT, ENDPOINT, 10.0, NOW)
    for role in ROLES:
        folder = tmp_path / "a" / role.name
        key = read_key(folder / "key.pem")
        assert key.public_key() == read_certificate(folder / "certificate.pem").public_key()
        config = section(BusConfig, "bus", read_settings(folder / "settings.toml"), {})
        assert config == BusConfig(
            endpoint=ENDPOINT,
            ca=str(folder / "ca.pem"),
            certificate=str(folder / "certificate.pem"),
            key=str(folder / "key.pem"),
        )


@pytest.mark.parametrize("umask", [0o000, 0o002, 0o027, 0o077])
def test_all_folders_of_a_site_are_for_their_owner_alone_whatever_the_umask(tmp_path: Path, umask: int) -> None:
    site, before = tmp_path / "new" / "site", os.umask(umask)
    try:
        make_site(site, ("a", "b"), ENDPOINT, ENDPOINT, 10.0, NOW)
        make_site(site, ("c",), ENDPOINT, ENDPOINT, 10.0, NOW)
    finally:
        os.umask(before)
    folders = [site.parent, *(path for path in (site, *site.rglob("*")) if path.is_dir())]
    assert len(folders) == 2 + 2 + 3 * (1 + len(ROLES))
    assert {stat.S_IMODE(folder.stat().st_mode) for folder in folders} == {0o700}


def test_private_keys_are_for_their_owner_s_eyes_and_the_authority_s_lies_in_one_place(tmp_path: Path) -> None:
    make_site(tmp_path, ("a",), ENDPOINT, ENDPOINT, 10.0, NOW)
    keys = list(tmp_path.rglob("key.pem"))
    assert len(keys) == len(ROLES) + 2
    for key in keys:
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
    secret = (tmp_path / "authority" / "key.pem").read_bytes()
    assert sum(secret in path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()) == 1


def test_a_plant_is_added_and_what_was_there_stays(tmp_path: Path) -> None:
    make_site(tmp_path, ("a",), ENDPOINT, ENDPOINT, 10.0, NOW)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.pem")}
    made = make_site(tmp_path, ("b",), None, None, 10.0, NOW)
    assert {path.read_bytes() == content for path, content in before.items()} == {True}
    assert made == [tmp_path / "b" / role.name for role in ROLES]
    rules = json.loads((tmp_path / "router" / "router.json5").read_text(encoding="utf-8"))
    assert rules["access_control"] == access_control(("a", "b"))
    assert rules["listen"]["endpoints"] == [ENDPOINT]
    assert section(BusConfig, "bus", read_settings(tmp_path / "b/viewer/settings.toml"), {}).endpoint == ENDPOINT


def test_a_certificate_is_renewed_and_a_plant_goes_by_deleting_its_folder(tmp_path: Path) -> None:
    make_site(tmp_path, ("a", "b"), ENDPOINT, None, 10.0, NOW)
    shutil.rmtree(tmp_path / "b")
    shutil.rmtree(tmp_path / "a" / "viewer")
    assert make_site(tmp_path, (), None, None, 10.0, NOW + 5 * DAY) == [tmp_path / "a" / "viewer"]
    renewed = read_certificate(tmp_path / "a" / "viewer" / "certificate.pem")
    assert renewed.not_valid_after_utc == NOW + 15 * DAY
    rules = json.loads((tmp_path / "router" / "router.json5").read_text(encoding="utf-8"))
    assert rules["access_control"] == access_control(("a",))


@pytest.mark.parametrize(
    ("plants", "endpoint", "expected"),
    [
        (("a/b",), ENDPOINT, "plant name must be"),
        (("router",), ENDPOINT, "choose another"),
        (("a",), "tcp/127.0.0.1:7447", "address must be like 'tls/127.0.0.1:7447'"),
        (("a",), "tls/127.0.0.1", "address must be like"),
    ],
)
def test_what_is_no_site_leaves_nothing_behind(
    tmp_path: Path, plants: tuple[str, ...], endpoint: str, expected: str
) -> None:
    with pytest.raises(InputError, match=expected):
        make_site(tmp_path / "site", plants, endpoint, ENDPOINT, 10.0, NOW)
    assert not (tmp_path / "site").exists()


def test_nothing_is_allowed_by_default_and_every_rule_is_used() -> None:
    access = access_control(("a", "b", "fleet"))
    assert access["default_permission"] == "deny"
    used = {rule for policy in access["policies"] for rule in policy["rules"]}
    assert used == {rule["id"] for rule in access["rules"]}


def test_no_rule_of_a_plant_reaches_another_but_for_tokens_of_fleets_and_what_readers_of_all_plants_ask() -> None:
    access = access_control(("a", "b", "fleet"))
    of_all = [rule for rule in access["rules"] if rule["id"].startswith("everyone") and "egress" in rule["flows"]]
    assert {message for rule in of_all for message in rule["messages"]} == {"declare_subscriber", "query"}
    rules = {rule["id"]: rule["key_exprs"] for rule in access["rules"] if rule not in of_all}
    for policy in access["policies"]:
        plant = policy["subjects"][0].split(".")[0].replace("@fleet", "*")
        allowed = [key for rule in policy["rules"] for key in rules.get(rule, ()) if key != keys.FLEET_TOKENS]
        assert {key.split("/")[1] for key in allowed} == {plant, "nobody"}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('ca = "ca.pem"', "ca, certificate and key belong together, got no certificate, key"),
        ('endpoint = "tls/127.0.0.1:7447"', "belong together, got 'tls/127.0.0.1:7447' without them"),
        (
            'endpoint = "tls/127.0.0.1:7447"\nca = "ca.pem"\ncertificate = "c.pem"\nkey = "k.pem"',
            "ca must be a file that is there",
        ),
        ('ca = "settings.toml"\ncertificate = "settings.toml"\nkey = "settings.toml"', "got 'tcp/127.0.0.1:7447' with"),
    ],
)
def test_half_an_identity_is_reported_in_one_line(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(f"[bus]\n{text}\n", encoding="utf-8")
    assert tomllib.loads(path.read_text(encoding="utf-8"))
    with pytest.raises(InputError) as caught:
        section(BusConfig, "bus", read_settings(path), {})
    assert expected in str(caught.value)


def test_a_damaged_authority_is_reported_in_one_line(tmp_path: Path) -> None:
    make_site(tmp_path, ("a",), ENDPOINT, ENDPOINT, 10.0, NOW)
    (tmp_path / "authority" / "ca.pem").write_text("no certificate", encoding="utf-8")
    with pytest.raises(InputError, match="is no certificate in PEM") as caught:
        make_site(tmp_path, ("a", "b"), ENDPOINT, ENDPOINT, 10.0, NOW)
    assert "\n" not in str(caught.value)
