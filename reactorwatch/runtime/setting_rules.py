"""Rules for every setting of every node, in addition to those of each structure."""

import math
import re
import types
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Annotated, Any, Literal, TypeAlias, Union, get_args, get_origin, get_type_hints

import msgspec

OlderKeys: TypeAlias = Mapping[str, tuple[str, Callable[[Any], Any]]]
"""Older names of keys, each with the present one and the function from a value of the older to one of it."""

MODEL_IS_PROCESS: OlderKeys = types.MappingProxyType({"model": ("process", lambda name: name)})
"""The older name of `process`."""

PROTOCOLS = ("tcp", "tls", "udp", "ws")
"""Protocols of an endpoint."""

LAST_PORT = 65535

MAX_SPAN_S = 2.0**62 / 1e9
"""146 years: sums of times must still fit 64 bits of nanoseconds."""

_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "days": 86_400.0}
_MAX_BITS = 63


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
    elif isinstance(values, int) and values.bit_length() > _MAX_BITS:
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
