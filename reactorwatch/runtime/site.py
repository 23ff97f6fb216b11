"""A site on disk: a folder for each who joins its bus, to be copied to the machine that it is for, as it is.

SITE/authority/             the authority's private key, which signs new certificates, and site.json, where the
                            router is: belongs off line
SITE/router/                certificate, key, the authority's certificate, and router.json5, Zenoh's settings
SITE/cstr/monitor/          certificate, key, the authority's certificate, and settings.toml for --config
SITE/cstr/viewer/ ...
"""

import datetime
import json
from pathlib import Path

import msgspec
from cryptography.hazmat.primitives import serialization

from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.runtime.access import ROLES, access_control, common_name
from reactorwatch.runtime.certificates import Identity, authority, issue, read_certificate, read_key

AUTHORITY, ROUTER = "authority", "router"
CA, CERTIFICATE, KEY = "ca.pem", "certificate.pem", "key.pem"
ROUTER_SETTINGS, SETTINGS = "router.json5", "settings.toml"
PLACE = "site.json"
DEFAULT_ENDPOINT = "tls/127.0.0.1:7447"
AUTHORITY_DAYS = 3650.0


def make_site(
    folder: Path,
    plants: tuple[str, ...],
    endpoint: str | None,
    listen: str | None,
    days: float,
    now: datetime.datetime,
) -> list[Path]:
    """Make what is not there yet of a site: its authority, the router, and every role of every plant.

    What is there stays as it is, but for the router's settings, which allow the plants that then are there. So a plant
    is added by naming it, and removed by deleting its folder; a certificate is renewed by deleting its folder first.

    Args:
        folder: of the site; made if it is not there.
        plants: those that should be there besides those that are; if there are none then, `cstr`.
        endpoint: where the nodes call the router, `tls/HOST:PORT`; the router's certificate is for that host. None: as
            before, or this machine's loopback.
        listen: where the router listens, likewise; None: as before, or where it is called.
        days: for how long certificates are valid.
        now: from when on.

    Returns:
        The folders that were made.

    Raises:
        InputError: the folder cannot be written, or holds a damaged authority; or an address or a name is none.
    """
    for plant in plants:
        try:
            keys.checked_plant(plant)
        except ValueError as error:
            raise InputError(f"--plant: {error}") from error
        if plant in (AUTHORITY, ROUTER):
            raise InputError(f"--plant {plant}: is the name of another folder of the site; choose another")
    before = _read_place(folder / AUTHORITY / PLACE)
    endpoint = endpoint or before.get("endpoint") or DEFAULT_ENDPOINT
    listen = listen or before.get("listen") or endpoint
    _host(listen)
    there = {path.parent.parent.name for path in folder.glob(f"*/*/{CERTIFICATE}")}
    plants = tuple(sorted(there.union(plants))) or ("cstr",)
    try:
        return _make(folder, plants, (endpoint, _host(endpoint), listen), days, now)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error


def _make(
    folder: Path, plants: tuple[str, ...], at: tuple[str, str, str], days: float, now: datetime.datetime
) -> list[Path]:
    endpoint, host, listen = at
    made: list[Path] = []
    ca = _authority(folder / AUTHORITY, now, made)
    place = json.dumps({"endpoint": endpoint, "listen": listen})
    (folder / AUTHORITY / PLACE).write_text(place + "\n", encoding="utf-8")
    router = folder / ROUTER
    hosts = tuple(dict.fromkeys((host, "localhost", "127.0.0.1")))
    _identity(router, ca, "router", (now, days), made, hosts)
    (router / ROUTER_SETTINGS).write_text(_router_settings(plants, listen), encoding="utf-8")
    for plant in plants:
        for role in ROLES:
            holder = folder / plant / role.name
            if _identity(holder, ca, common_name(plant, role.name), (now, days), made):
                (holder / SETTINGS).write_text(_settings(plant, endpoint), encoding="utf-8")
    return made


def _authority(folder: Path, now: datetime.datetime, made: list[Path]) -> Identity:
    if folder.is_dir():
        return Identity(read_certificate(folder / CA), read_key(folder / KEY))
    folder.mkdir(parents=True, mode=0o700)
    ca = authority(f"reactorwatch {now:%Y-%m-%d}", now, AUTHORITY_DAYS)
    ca.write(folder / CA, folder / KEY)
    made.append(folder)
    return ca


def _read_place(path: Path) -> dict[str, str]:
    """Where the router of a site is; empty if it has none yet."""
    if not path.exists():
        return {}
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, str])
    except (OSError, msgspec.DecodeError) as error:
        raise InputError(f"{path}: cannot be read as what `certify` has written there: {error}") from error


def _identity(
    folder: Path,
    ca: Identity,
    name: str,
    validity: tuple[datetime.datetime, float],
    made: list[Path],
    hosts: tuple[str, ...] = (),
) -> bool:
    """Make a folder with a new certificate in it, if there is none."""
    if folder.is_dir():
        return False
    folder.mkdir(parents=True)
    issue(ca, name, *validity, hosts).write(folder / CERTIFICATE, folder / KEY)
    (folder / CA).write_bytes(ca.certificate.public_bytes(serialization.Encoding.PEM))
    made.append(folder)
    return True


def _router_settings(plants: tuple[str, ...], listen: str) -> str:
    """For `zenohd --config` and `reactorwatch router`; files are relative to the folder they are in."""
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
            "link": {
                "protocols": ["tls"],
                "tls": tls,
                "tx": {"queue": {"congestion_control": {"block": {"wait_before_close": 1_000_000}}}},
            }
        },
        "access_control": access_control(plants),
    }
    return json.dumps(settings, indent=2) + "\n"


def _settings(plant: str, endpoint: str) -> str:
    """For `--config`: where the router is, who we are, and which plant it is about."""
    identity = f'ca = "{CA}"\ncertificate = "{CERTIFICATE}"\nkey = "{KEY}"\n'
    tables = [f'[bus]\nendpoint = "{endpoint}"\n{identity}']
    tables.append(f'[plant]\nname = "{plant}"\n')
    tables += [f'[{table}]\nplant = "{plant}"\n' for table in ("monitor", "replay")]
    # a subscription to more than may be read would be refused as a whole
    tables.append(f'[recorder]\nplant = "{plant}"\nkey_expression = "{keys.ROOT}/{plant}/**"\n')
    return "\n".join(tables)


def _host(endpoint: str) -> str:
    """The host of an address.

    Raises:
        InputError: it is no address for TLS.
    """
    protocol, _, place = endpoint.partition("/")
    host, colon, port = place.rpartition(":")
    if protocol != "tls" or not host or not colon or not port.isdigit():
        raise InputError(f"address must be like 'tls/127.0.0.1:7447', got {endpoint!r}")
    return host.strip("[]")
