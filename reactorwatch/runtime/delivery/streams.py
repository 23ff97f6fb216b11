"""Streams: the groups of keys in which publishers number their messages.

A subscriber drops a number that it has already seen as a repetition. So numbers must be counted among messages that
only one role may publish: otherwise the holder of another role's certificate could publish on its own keys with the
publisher's name and next numbers, and have the publisher's messages dropped. The access rules (`acl`) define which role
publishes on a key; a stream is all of one kind of one plant that one role may publish.
"""

from functools import lru_cache

from reactorwatch.contract import keys
from reactorwatch.runtime.security.acl import ROLES, Role

STREAM_PARTS = 3
"""Parts of a key that a stream has in common: root, plant and kind."""
MAX_CACHED = 1000
"""Names below a plant whose role is cached: all plants have the same ones, and made-up names evict each other."""

_KEY_SPACES = sorted(
    ((expression, role) for role in ROLES for expression in role.key_space),
    key=lambda item: item[0].count("/"),
    reverse=True,
)
"""Narrowest first: the monitor's expression also matches the recorder's own alarms."""


@lru_cache(maxsize=MAX_CACHED)
def role_of_key(name: str) -> Role | None:
    """Role that may publish on a key; None if no role may.

    Args:
        name: the key below its plant.

    >>> [role_of_key(name).name for name in ("alarm/ewma/T", "alarm/recording/disk", "health/plant")]
    ['monitor', 'recorder', 'plant']
    >>> role_of_key("health/somebody") is None
    True
    """
    return next((role for expression, role in _KEY_SPACES if keys.matches(expression, name)), None)


def stream_of(key: str) -> str:
    """Stream of a key: root, plant and kind, and the role where it does not publish all of the kind.

    >>> stream_of("reactor/cstr/chart/ewma/T"), stream_of("reactor/cstr/alarm/recording/disk")
    ('reactor/cstr/chart', 'reactor/cstr/alarm/@recorder')
    """
    parts = key.split("/")
    kind = "/".join(parts[:STREAM_PARTS])
    if parts[0] != keys.ROOT or len(parts) < STREAM_PARTS:
        return kind
    role = role_of_key("/".join(parts[2:]))
    if role is None:
        return f"{kind}/@none"
    return kind if f"{parts[2]}/**" in role.key_space else f"{kind}/@{role.name}"


def keys_of(stream: str) -> str:
    """Key expression that matches all keys of a stream, and perhaps those of other roles.

    >>> keys_of("reactor/cstr/alarm/@recorder")
    'reactor/cstr/alarm/**'
    """
    return "/".join((*stream.split("/")[:STREAM_PARTS], "**"))
