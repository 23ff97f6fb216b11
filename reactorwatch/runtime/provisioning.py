"""Provisioning of a site: a folder for each client of its bus, to be copied to the client's machine unchanged.

SITE/authority/             the authority's private key, which signs new certificates, and site.json with the router's
                            address: belongs off line
SITE/router/                certificate, key, the authority's certificate, and router.json5, Zenoh's settings
SITE/cstr/monitor/          certificate, key, the authority's certificate, and settings.toml for --config
SITE/cstr/viewer/ ...
SITE/fleet/monitor/ ...     the same for clients for all plants, where there are any
SITE/fleet/cluster/         certificate, key and authority of the Dask cluster of a fleet, and Dask's settings with them
"""

import datetime
import json
import re
import secrets
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import tomli_w
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization

from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.limits import parse_json
from reactorwatch.records.decode import read_regular
from reactorwatch.records.write import atomic_write
from reactorwatch.runtime.acl import FLEET, ROLES, SERIAL_BYTES, access_control, common_name, roles_of
from reactorwatch.runtime.certificates import (
    Identity,
    issue,
    make_authority,
    read_certificate,
    read_common_name,
    read_key,
)
from reactorwatch.runtime.config import LAST_PORT

AUTHORITY, ROUTER = "authority", "router"
CA, CERTIFICATE, KEY = "ca.pem", "certificate.pem", "key.pem"
ROUTER_SETTINGS, SETTINGS = "router.json5", "settings.toml"
REGISTER_FILE = "site.json"
CLUSTER, CLUSTER_SETTINGS = "cluster", "cluster.yaml"
FILES = (CA, CERTIFICATE, KEY, ROUTER_SETTINGS, SETTINGS, REGISTER_FILE, CLUSTER_SETTINGS)
ALL = "*"
"""Names all plants in place of a plant."""
DEFAULT_ENDPOINT = "tls/127.0.0.1:7447"

MAX_PLANT_NAME = 64 - max(len(common_name("", role.name)) for role in ROLES) - 2 * SERIAL_BYTES - 1


class Register(msgspec.Struct, forbid_unknown_fields=True):
    """Addresses of a site's router, and valid common names of its certificates: `SITE/authority/site.json`.

    Attributes:
        endpoint: the address at which nodes connect to the router.
        listen: the address at which it listens.
        names: common names of certificates by holder, such as `cstr/monitor`, where earlier ones were revoked.
        revoked: common names that the router refuses, oldest first.
    """

    endpoint: str
    listen: str
    names: dict[str, str] = {}
    revoked: list[str] = []

    def name_of(self, holder: str) -> str:
        """Common name of a holder's certificates."""
        plant, _, role = holder.partition("/")
        return self.names.get(holder) or common_name(plant, role)

    def revoke(self, holder: str) -> str:
        """Revoke all present certificates of a holder; returns their common name."""
        name = self.name_of(holder)
        plant, _, role = holder.partition("/")
        self.revoked.append(name)
        self.names[holder] = f"{common_name(plant, role)}.{secrets.token_hex(SERIAL_BYTES)}"
        return name

    def write(self, path: Path) -> None:
        """Write the file, completely or not at all."""
        with atomic_write(path) as part:
            part.write_bytes(msgspec.json.encode(self) + b"\n")


def read_register(path: Path) -> Register | None:
    """Read the register of a site; None if there is none.

    Raises:
        InputError: the file cannot be read.
    """
    if not path.exists():
        return None
    try:
        return msgspec.convert(parse_json(read_regular(path)), Register)
    except (OSError, InputError, msgspec.ValidationError) as error:
        raise InputError(f"{path}: cannot be read as what `certify` has written there: {error}") from error


def make_site(
    folder: Path,
    plants: tuple[str, ...],
    endpoint: str | None,
    listen: str | None,
    days: float,
    now: datetime.datetime,
    *,
    renew_days: float | None = None,
    revoke: Sequence[str] = (),
) -> list[Path]:
    """Make the missing parts of a site: its authority, the router, and every role of every plant or of all plants.

    Complete folders stay unchanged, except for the router's settings, which allow the plants of the site. A folder with
    a missing or damaged file is completed. A plant is removed by deleting its folder.

    Args:
        folder: the site's folder; made if it does not exist.
        plants: names of plants to add; `*` adds the roles for all plants. A new site without any gets `cstr`.
        endpoint: address at which nodes connect to the router, `tls/HOST:PORT`; the router's certificate is for that
            host. None: as before, or this machine's loopback.
        listen: address at which the router listens, of the same form. None: as before, or `endpoint`.
        days: days for which new certificates are valid.
        now: time from which new certificates are valid.
        renew_days: certificates that end within this many days are renewed. None: none is.
        revoke: holders, such as `cstr/monitor`, whose present certificates the router is to refuse; each gets a new
            one.

    Returns:
        The folders that were made, completed or given a new certificate.

    Raises:
        InputError: the folder cannot be written, its authority is missing or damaged, or an argument is invalid.
    """
    _check(plants, days)
    there = _find_plants(folder)
    plants = tuple(sorted({*there, *(FLEET if plant == ALL else plant for plant in plants)}))
    if not plants and not (folder / AUTHORITY).is_dir():
        plants = (keys.DEFAULT_PLANT,)
    holders = _list_holders(plants)
    for holder in revoke:
        if holder not in holders:
            raise InputError(
                f"--revoke {holder}: is no PLANT/ROLE of this site (valid: {', '.join(holders) or 'none'})"
            )
    cluster = f"{FLEET}/{CLUSTER}"
    _check_paths(folder, [*holders, cluster])
    register = _update_register(folder, there, endpoint, listen)
    try:
        ca, made = _load_authority(folder / AUTHORITY, now, is_old=_has_certificates(folder, there))
        for holder in revoke:
            register.revoke(holder)
        register.write(folder / AUTHORITY / REGISTER_FILE)
        until = now + datetime.timedelta(days=renew_days) if renew_days is not None else now
        issuer = _Issuer(ca, now, days, until)
        host = _parse_host(register.endpoint)
        hosts = tuple(dict.fromkeys((host, "localhost", "127.0.0.1")))
        if issuer.complete(folder / ROUTER, ROUTER, hosts):
            made.append(folder / ROUTER)
        rules = access_control(plants, register.names, register.revoked)
        with atomic_write(folder / ROUTER / ROUTER_SETTINGS) as part:
            part.write_text(_router_settings(rules, register.listen), encoding="utf-8")
        for holder in holders:
            settings = _settings(holder, register.endpoint)
            if issuer.complete(folder / holder, register.name_of(holder), settings=settings):
                made.append(folder / holder)
        if FLEET in plants and _complete_cluster(folder / cluster, now, days, until):
            made.append(folder / cluster)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error
    return made


def _list_holders(plants: Sequence[str]) -> list[str]:
    """Holders of certificates, which are paths of their folders in a site: `cstr/monitor`, `fleet/monitor`."""
    return [f"{plant}/{role.name}" for plant in plants for role in roles_of(plant)]


def _check(plants: tuple[str, ...], days: float) -> None:
    for plant in plants:
        if plant == ALL:
            continue
        try:
            keys.check_plant(plant)
        except ValueError as error:
            raise InputError(f"--plant: {error}") from error
        if plant in (AUTHORITY, ROUTER, FLEET):
            raise InputError(f"--plant {plant}: is the name of another folder of the site; choose another")
        if len(plant) > MAX_PLANT_NAME:
            raise InputError(
                f"--plant {plant}: a plant of a site has at most {MAX_PLANT_NAME} letters, because certificates hold "
                f"64, got {len(plant)}"
            )
    if not 1.0 <= days <= 3650.0:
        raise InputError(f"--days must be in [1, 3650], got {days:g}")


def _check_paths(folder: Path, holders: list[str]) -> None:
    """Check, before anything is written, that every path of a site is free or of its kind."""
    for name in (AUTHORITY, ROUTER, *holders):
        home = folder / name
        for path in (folder, home.parent, home):
            if (path.exists() or path.is_symlink()) and not path.is_dir():
                raise InputError(f"{path}: is no folder, and a site has one there; move it out of the site")
        for file in (home / name for name in FILES):
            if file.exists() and not file.is_file():
                raise InputError(f"{file}: is no regular file, and a site has one there; move it out of the site")


def _find_plants(folder: Path) -> list[str]:
    """Names of the plants with a folder in a site; `FLEET`: there are folders for all plants."""
    plants = []
    for holder in sorted(folder.glob("*/*")):
        plant = holder.parent.name
        if holder.is_dir() and holder.name in {role.name for role in ROLES} and plant not in (AUTHORITY, ROUTER):
            if plant == FLEET and holder.name not in {role.name for role in roles_of(plant)}:
                raise InputError(
                    f"{holder}: {FLEET} is the folder for all plants of the site; name this plant otherwise"
                )
            try:
                plants.append(keys.check_plant(plant))
            except ValueError as error:
                raise InputError(f"{holder.parent}: is no plant's folder; move it out of the site: {error}") from error
    return list(dict.fromkeys(plants))


def _has_certificates(folder: Path, there: list[str]) -> bool:
    """True if a site has certificates, and so an authority that exists somewhere."""
    return any((folder / holder / CERTIFICATE).exists() for holder in (ROUTER, *_list_holders(there)))


def _update_register(folder: Path, there: list[str], endpoint: str | None, listen: str | None) -> Register:
    """The register of the site with the given addresses."""
    home = folder / AUTHORITY
    is_old = _has_certificates(folder, there)
    if is_old and not (home / KEY).exists():
        raise InputError(
            f"{home}: the site's authority is not there, and its private key signs all certificates; put that folder "
            "back, or start a new site in another folder"
        )
    before = read_register(home / REGISTER_FILE)
    if before is None and is_old and (endpoint is None or listen is None):
        raise InputError(
            f"{home / REGISTER_FILE}: is missing, so the address of the router is unknown; give --endpoint and --listen"
        )
    if before is None:
        called = endpoint or DEFAULT_ENDPOINT
        before = Register(called, listen or called)
    register = Register(endpoint or before.endpoint, listen or before.listen, before.names, before.revoked)
    for address in (register.endpoint, register.listen):
        _parse_host(address)
    return register


def _load_authority(folder: Path, now: datetime.datetime, *, is_old: bool) -> tuple[Identity, list[Path]]:
    """Load the authority of a site, or make that of a new site; returns it with the folders made."""
    if (folder / CA).exists() or is_old:
        return Identity(read_certificate(folder / CA), read_key(folder / KEY)), []
    ca = make_authority(f"reactorwatch {now:%Y-%m-%d}", now, 3650.0)
    _install(folder, lambda new: ca.write(new / CA, new / KEY))
    return ca, [folder]


class _Issuer:
    """Completes folders of identities; certificates that end before `until` are renewed."""

    def __init__(self, ca: Identity, now: datetime.datetime, days: float, until: datetime.datetime) -> None:
        self._ca, self._now, self._days, self._until = ca, now, days, until
        if ca.certificate.not_valid_after_utc <= now:
            raise InputError(
                f"the authority's certificate ended on {ca.certificate.not_valid_after_utc:%Y-%m-%d}; make a new site"
            )
        self._ca_pem = ca.certificate.public_bytes(serialization.Encoding.PEM)

    def complete(self, folder: Path, name: str, hosts: tuple[str, ...] = (), settings: str = "") -> bool:
        """Make the missing, damaged and outdated files of a folder; returns False if there are none."""
        is_new = not _is_valid(folder, name, self._ca.certificate, self._until)
        if not is_new and (folder / CA).is_file() and (not settings or (folder / SETTINGS).is_file()):
            return False

        def write(new: Path) -> None:
            if is_new:
                issue(self._ca, name, self._now, self._days, hosts).write(new / CERTIFICATE, new / KEY)
            (new / CA).write_bytes(self._ca_pem)
            if settings and not (folder / SETTINGS).exists():  # it may have been edited
                (new / SETTINGS).write_text(settings, encoding="utf-8")

        _install(folder, write)
        return True


def _is_valid(folder: Path, name: str, ca: x509.Certificate, until: datetime.datetime) -> bool:
    try:
        certificate, key = read_certificate(folder / CERTIFICATE), read_key(folder / KEY)
        certificate.verify_directly_issued_by(ca)
    except (InputError, ValueError, TypeError, InvalidSignature):
        return False
    is_pair = key.public_key() == certificate.public_key()
    return is_pair and read_common_name(certificate) == name and certificate.not_valid_after_utc > until


def _complete_cluster(folder: Path, now: datetime.datetime, days: float, until: datetime.datetime) -> bool:
    """Make or renew the identity of a fleet's Dask cluster; returns False if it is complete.

    A program with a certificate of the cluster's authority runs code on its workers. So the authority is not that of
    the site, whose certificates every viewer has: it signs this one certificate, and its key is not kept.
    """
    try:
        is_new = not _is_valid(folder, CLUSTER, read_certificate(folder / CA), until)
    except InputError:
        is_new = True
    settings = folder / CLUSTER_SETTINGS
    if not is_new and settings.is_file() and settings.read_bytes() == _cluster_settings(folder):
        return False

    def write(new: Path) -> None:
        if is_new:
            ca = make_authority(f"reactorwatch cluster {now:%Y-%m-%d}", now, days)
            issue(ca, CLUSTER, now, days, is_peer=True).write(new / CERTIFICATE, new / KEY)
            (new / CA).write_bytes(ca.certificate.public_bytes(serialization.Encoding.PEM))
        (new / CLUSTER_SETTINGS).touch(mode=0o600)
        (new / CLUSTER_SETTINGS).write_bytes(_cluster_settings(new if is_new else folder))

    _install(folder, write)
    return True


def _cluster_settings(folder: Path) -> bytes:
    """Settings of Dask's scheduler and workers, which read the YAML files of the folder `DASK_CONFIG`.

    They hold the certificates themselves, as a path would be relative to the folder in which Dask is started.
    """
    ca, certificate, key = (
        (folder / name).read_text(encoding="utf-8", errors="replace") for name in (CA, CERTIFICATE, KEY)
    )
    identity = {"cert": certificate, "key": key}
    tls = {"ca-file": ca, "scheduler": identity, "worker": identity, "client": identity}
    settings = {
        "comm": {"require-encryption": True, "tls": tls},
        # a lost worker is noticed within seconds, and a shard, which is never the reason for it, is never given up
        "scheduler": {"worker-ttl": "2s", "allowed-failures": 1_000_000, "http": {"routes": []}},
        "worker": {"http": {"routes": []}},  # pages have neither encryption nor a password
    }
    return json.dumps({"distributed": settings}, indent=2).encode() + b"\n"


def _make_private(folder: Path) -> None:
    """Make a folder, and those above it that are missing, for its owner alone, whatever the umask is."""
    if not folder.is_dir():
        _make_private(folder.parent)
        folder.mkdir(mode=0o700)
        folder.chmod(0o700)


def _install(folder: Path, write: Callable[[Path], None]) -> None:
    """Write files to a temporary folder and move them into `folder`; a new folder appears complete."""
    new = folder.with_name(f".{folder.name}.new")
    if new.is_symlink() or new.is_file():
        new.unlink()
    shutil.rmtree(new, ignore_errors=True)
    _make_private(new)
    write(new)
    if not folder.exists():
        new.rename(folder)
        return
    for file in sorted(new.iterdir()):
        file.replace(folder / file.name)
    new.rmdir()


def _router_settings(rules: dict[str, Any], listen: str) -> str:
    """Settings for `zenohd --config` and `reactorwatch router`; files are relative to their folder."""
    tls = {
        "root_ca_certificate": CA,
        "listen_certificate": CERTIFICATE,
        "listen_private_key": KEY,
        "enable_mtls": True,
        "close_link_on_expiration": True,
    }
    settings = {
        "mode": "router",
        "listen": {"endpoints": [listen], "timeout_ms": 0, "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "adminspace": {"enabled": False},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "protocols": ["tls"],
                "tls": tls,
                "tx": {"queue": {"congestion_control": {"block": {"wait_before_close": 1_000_000}}}},
            },
        },
        "access_control": rules,
    }
    return json.dumps(settings, indent=2) + "\n"


def _settings(holder: str, endpoint: str) -> str:
    """Settings for `--config`: the router's address, the files of the identity, and the plant or plants."""
    plant, _, role = holder.partition("/")
    plants = f"{keys.ROOT}/{'*' if plant == FLEET else plant}"
    named: dict[str, dict[str, str]] = {
        "plant": {"name": plant},
        "monitor": {"plant": plant},
        "replay": {"plant": plant},
    }
    of_monitor = {"fleet": {"plants": plants, "identity": f"../{CLUSTER}"}}
    tables = {
        "bus": {"endpoint": endpoint, "ca": CA, "certificate": CERTIFICATE, "key": KEY},
        **(named if plant != FLEET else of_monitor if role == "monitor" else {}),
        # a subscription wider than the rights would be refused as a whole
        "recorder": {"plant": plant, "key_expression": f"{plants}/**"},
    }
    return tomli_w.dumps(tables)


_ADDRESS = re.compile(r"tls/(?P<host>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):(?P<port>\d{1,5})")


def _parse_host(endpoint: str) -> str:
    """Host of an address."""
    match = _ADDRESS.fullmatch(endpoint)
    if match is None or not 1 <= int(match["port"]) <= LAST_PORT:
        raise InputError(
            f"address must be like 'tls/127.0.0.1:7447', of letters, digits, '.' and '-', with a port up to "
            f"{LAST_PORT}, got {endpoint!r}"
        )
    return match["host"].strip("[]")
