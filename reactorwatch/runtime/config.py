"""Settings: one frozen structure per node; defaults, then a TOML file, then the command's flags.

One file may serve all nodes, with a table for each:

    [bus]
    endpoint = "tcp/127.0.0.1:7447"

    [plant]
    name = "cstr"

Rules for all settings: numbers fit 64 bits, and spans of time 146 years (`check_values`, `check_spans`).
"""

import math
import re
import types
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.limits import Limits, parse_toml, set_limits
from reactorwatch.records.decode import read_regular

OlderKeys: TypeAlias = Mapping[str, tuple[str, Callable[[Any], Any]]]
"""Older names of keys, each with the present one and the function from a value of the older to one of it."""

MODEL_IS_PROCESS: OlderKeys = types.MappingProxyType({"model": ("process", lambda name: name)})
"""The older name of `process`."""

PROTOCOLS = ("tcp", "tls", "udp", "ws")
"""Protocols of an endpoint."""

LAST_PORT = 65535  # 16 bits

MAX_SPAN_S = 2.0**62 / 1e9
"""146 years: sums of times must still fit 64 bits of nanoseconds."""

_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "days": 86_400.0}


def check_values(values: object, name: str = "") -> None:
    """Check that numbers fit 64 bits and that texts can be names of files.

    Args:
        values: a value or table as read: numbers, texts, lists and tables.
        name: name of the setting, for messages.

    Raises:
        ValueError: a value breaks a rule.
    """
    if isinstance(values, dict):
        for key, value in values.items():
            check_values(key, name or "a name")
            check_values(value, f"{name}.{key}" if name else str(key))
    elif isinstance(values, list | tuple):
        for value in values:
            check_values(value, name)
    elif isinstance(values, str) and "\0" in values:
        raise ValueError(f"{name} must not hold the character NUL, got {values!r}")
    elif isinstance(values, int) and values.bit_length() > 63:
        raise ValueError(f"{name} must be a number of 64 bits, got one of {values.bit_length()}")


def check_bounds(kind: type[msgspec.Struct], values: Mapping[str, object]) -> None:
    """Check numbers whose bounds are annotated, as in `Annotated[float, msgspec.Meta(ge=0.1, le=3600.0)]`.

    msgspec checks them too, but not of settings that are made in Python, and without naming the value.

    Args:
        kind: class of the settings.
        values: values by key; those that are no numbers are skipped.

    Raises:
        ValueError: a number out of its bounds.
    """
    for name, (lower, upper) in _bounds(kind).items():
        value = values.get(name)
        if isinstance(value, int | float) and not lower <= value <= upper:
            raise ValueError(f"{name} must be in [{lower:g}, {upper:g}], got {value:g}")


@cache
def _bounds(kind: type[msgspec.Struct]) -> dict[str, tuple[float, float]]:
    """Lower and upper bound of each setting that has them."""
    return {
        name: (meta.ge, meta.le)
        for name, hint in get_type_hints(kind, include_extras=True).items()
        for part in (hint, *get_args(hint))  # the setting may be optional
        if get_origin(part) is Annotated
        for meta in part.__metadata__
        if isinstance(meta, msgspec.Meta) and meta.ge is not None and meta.le is not None
    }


def check_spans(settings: msgspec.Struct) -> None:
    """Check the range of durations, found by the unit at the end of a name; one in l/min is a flow.

    Raises:
        ValueError: a duration is finite and longer than 146 years.
    """
    for name, value in msgspec.structs.asdict(settings).items():
        if isinstance(value, msgspec.Struct):
            check_spans(value)
        seconds = _SECONDS.get(name.rpartition("_")[2])
        if seconds is None or name.endswith("_l_min") or not isinstance(value, float) or math.isinf(value):
            continue
        if not abs(value) <= MAX_SPAN_S / seconds:
            raise ValueError(f"{name} must be at most {MAX_SPAN_S / seconds:.3g}, which is 146 years, got {value:g}")


def check_endpoint(endpoint: str) -> str:
    """Check that an endpoint is a protocol, a host and a port; returns it.

    Raises:
        ValueError: it is not.
    """
    protocol, slash, address = endpoint.partition("/")
    host, colon, port = re.split(r"[?#]", address, maxsplit=1)[0].rpartition(":")
    if not (slash and host and colon) or "/" in host:
        raise ValueError(f"endpoint must be like 'tcp/127.0.0.1:7447', got {endpoint!r}")
    if protocol not in PROTOCOLS:
        raise ValueError(
            f"endpoint must begin with one of {', '.join(f'{item}/' for item in PROTOCOLS)}, got {endpoint!r}"
        )
    if not (port.isdecimal() and port.isascii() and 1 <= int(port[: len(str(LAST_PORT)) + 1]) <= LAST_PORT):
        raise ValueError(f"the port of an endpoint must be in [1, {LAST_PORT}], got {endpoint!r}")
    return endpoint


def valid_choices(kind: object, path: str) -> tuple[str, ...]:
    """Valid words of a setting; empty if it is not a choice.

    Args:
        kind: class of the settings.
        path: path of the setting in msgspec's form, such as `$.charts[0]`.
    """
    kinds = [kind]
    for name in re.findall(r"\.([A-Za-z_]\w*)", path):
        kinds = [
            get_type_hints(item)[name]
            for item in _parts(kinds)
            if isinstance(item, type) and issubclass(item, msgspec.Struct) and name in item.__struct_fields__
        ]
    return tuple(
        word
        for item in _parts(kinds)
        if get_origin(item) is Literal
        for word in get_args(item)
        if isinstance(word, str)
    )


def _parts(kinds: list[Any]) -> Iterator[Any]:
    """Yield types, and the arguments of unions and containers."""
    for kind in kinds:
        yield kind
        if get_origin(kind) in (Union, types.UnionType, tuple, list, dict):
            yield from _parts(list(get_args(kind)))


SECTIONS = ("bus", "plant", "monitor", "fleet", "recorder", "replay", "diagnosis", "metrics", "log", "limits")
"""Valid tables of a settings file."""

IDENTITY = ("ca", "certificate", "key")
"""Files with which a node authenticates itself and the router."""


class BusConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Connection to the bus.

    Attributes:
        endpoint: the router's address, by default on loopback.
        routers: addresses of other routers that a router connects to, so that they form one bus; they may start later,
            and restart. Of two routers, one has to name the other.
        congestion: behaviour of a publisher on a congested network: drop messages (`drop`) and resend those that are
            queried; or wait (`block`), so that one stuck subscriber slows the others.
        cache_messages: number of messages on each key that a publisher caches for recovery after a loss. A message
            takes half a kilobyte.
        history_s: age of the oldest earlier publications that a starting recorder receives, in seconds.
        ca: file with the certificate of the site's authority (PEM). With it, a certificate and its key, the bus is
            joined by mutual TLS. In a settings file, the path is relative to that file's folder.
        certificate: file with the node's certificate (PEM), path as of `ca`.
        key: file with the private key of that certificate (PEM), path as of `ca`.
    """

    endpoint: str = "tcp/127.0.0.1:7447"
    routers: tuple[str, ...] = ()
    congestion: Literal["block", "drop"] = "drop"
    cache_messages: Annotated[int, msgspec.Meta(ge=1, le=10_000_000)] = 10_000
    history_s: float = 60.0
    ca: str | None = None
    certificate: str | None = None
    key: str | None = None

    def __post_init__(self) -> None:
        for endpoint in (self.endpoint, *self.routers):
            check_endpoint(endpoint)
        check_bounds(BusConfig, msgspec.structs.asdict(self))
        if not 0.0 < self.history_s <= 86_400.0:
            raise ValueError(f"history_s must be in (0, 86400], got {self.history_s:g}")
        given = [name for name in IDENTITY if getattr(self, name) is not None]
        if given and len(given) < len(IDENTITY):
            missing = ", ".join(name for name in IDENTITY if name not in given)
            raise ValueError(f"ca, certificate and key belong together, got no {missing}")
        if bool(given) != self.endpoint.startswith("tls/"):
            raise ValueError(
                f"an endpoint like 'tls/127.0.0.1:7447' and ca, certificate and key belong together, got "
                f"{self.endpoint!r} {'with' if given else 'without'} them"
            )
        for name in given:
            if not Path(getattr(self, name)).is_file():
                raise ValueError(f"{name} must be a file that is there, got {getattr(self, name)!r}")


class MetricsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pages for Prometheus.

    Attributes:
        port: port of the plant's page; the monitor's is the next one, the recorder's the one after, so that the nodes
            can share one file. None: no pages.
        address: address of this machine at which the pages are served, by default loopback.
    """

    port: Annotated[int, msgspec.Meta(ge=1, le=LAST_PORT - 2)] | None = None
    address: str = "127.0.0.1"

    def __post_init__(self) -> None:
        check_bounds(MetricsConfig, msgspec.structs.asdict(self))
        try:
            ip_address(self.address)
        except ValueError:
            raise ValueError(
                f"address must be an IP address of this machine, such as 127.0.0.1, got {self.address!r}"
            ) from None


class LogConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Log of a node, on standard error.

    Attributes:
        format: `text`, a line for people; or `json`, an object a line.
    """

    format: Literal["text", "json"] = "text"


Section = TypeVar("Section", bound=msgspec.Struct)

_NO_CHOICE = "Invalid enum value"
"""Start of msgspec's message for an invalid word."""


def read_settings(path: Path | None) -> dict[str, dict[str, Any]]:
    """Read the tables of a settings file, and set the limits that it states; empty without a file.

    Raises:
        InputError: the file does not exist, is not TOML, or holds an unknown table or invalid limits.
    """
    if path is None:
        return {}
    try:
        tables = parse_tables(read_regular(path))
    except OSError as error:
        raise InputError(f"settings file {path}: cannot be read: {error.strerror}") from error
    except InputError as error:
        raise InputError(f"settings file {path}: {error}") from error
    for name in tables:
        if name not in SECTIONS:
            raise InputError(f"settings file {path}: {describe_unknown('table', name, SECTIONS)}")
    if "limits" in tables:
        set_limits(section(Limits, "limits", tables, {}))
    for table, names in (("bus", IDENTITY), ("fleet", ("identity",))):
        settings = tables.get(table, {})
        for name in names:
            if isinstance(settings.get(name), str):  # a folder with settings and certificates can be moved
                settings[name] = str(path.parent / settings[name])
    return tables


def parse_tables(content: bytes) -> dict[str, dict[str, Any]]:
    """Parse the tables of a settings file.

    Raises:
        InputError: as `parse_toml`, or it holds a value outside of a table.
    """
    tables = parse_toml(content)
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise InputError(f"'{name}' must be a table, like [{name}]")
    return tables


def section(kind: type[Section], name: str, tables: dict[str, dict[str, Any]], flags: dict[str, Any]) -> Section:
    """Settings of one node: defaults < preset < file < flags.

    Args:
        kind: class of the settings, with their defaults. If it has `presets`, settings by name, the key `preset` names
            one. If it has `older_keys`, by older name the present one and a conversion of the value, both are valid;
            a key whose present name is empty has no effect any more.
        name: name of the table in the file.
        tables: the tables from `read_settings`.
        flags: values of the command line, by key; None: not given.

    Raises:
        InputError: an unknown key or preset, or a value that breaks a rule.
    """
    given = {key: value for key, value in flags.items() if value is not None}
    values = {**_rename_older(kind, name, tables.get(name, {})), **_rename_older(kind, name, given)}
    fields = tuple(field.name for field in msgspec.structs.fields(kind))
    presets: dict[str, dict[str, Any]] | None = getattr(kind, "presets", None)
    if presets is not None:
        fields = (*fields, "preset")
        preset = values.pop("preset", None)
        if preset is not None:
            if not isinstance(preset, str) or preset not in presets:
                raise InputError(f"settings [{name}]: {describe_unknown('preset', str(preset), tuple(presets))}")
            values = {**presets[preset], **values}
    for key in values:
        if key not in fields:
            raise InputError(f"settings [{name}]: {describe_unknown('key', key, fields)}")
    try:
        check_values(values)
        check_bounds(kind, values)
        settings = msgspec.convert(values, kind)
        check_spans(settings)
    except msgspec.ValidationError as error:
        raise InputError(f"settings [{name}]: {_describe_refusal(kind, str(error))}") from error
    except (ValueError, OverflowError) as error:
        raise InputError(f"settings [{name}]: {error}") from error
    return settings


def _describe_refusal(kind: object, text: str) -> str:
    """Describe an invalid word by the setting and the valid words; other messages of msgspec stay as they are."""
    rule, _, path = text.partition(" - at ")
    words = valid_choices(kind, path.strip("`")) if rule.startswith(_NO_CHOICE) else ()
    if not words:
        return text
    setting, word = path.strip("`").removeprefix("$."), rule.removeprefix(_NO_CHOICE).strip(" '")
    return f"{setting}: {describe_unknown('word', word, words)}"


def _rename_older(kind: type[Section], name: str, values: dict[str, Any]) -> dict[str, Any]:
    """Values with the present names of their keys."""
    renamed = dict(values)
    for older, (key, convert) in getattr(kind, "older_keys", {}).items():
        if older not in values:
            continue
        if key in values:
            raise InputError(f"settings [{name}]: {older!r} is an older name of {key!r}, got both; leave {older!r} out")
        value = renamed.pop(older)
        if key:
            renamed[key] = convert(value)
    return renamed
