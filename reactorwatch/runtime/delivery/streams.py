"""The streams in which publishers number their messages.

A publisher numbers what it publishes on the keys of a stream, and a subscriber takes a number that has passed for a
repetition. So a number may count only among messages that one and the same role may publish: a holder of another
role's certificate, which publishes on keys of its own with the publisher's name and its next numbers, would otherwise
have the publisher's messages dropped. The access rules (`access`) say which role publishes on a key, and a stream is
all of one kind of one plant that one role may publish.
"""

from functools import lru_cache

from reactorwatch.contract import keys
from reactorwatch.runtime.security.acl import ROLES, Role

STREAM_PARTS = 3
"""Parts of a key that a stream has in common: root, plant and kind."""
MOST_CACHED = 1000
"""Names below a plant whose role is kept: all plants have the same ones, and made-up names push each other out."""

_KEY_SPACES = sorted(
    ((expression, role) for role in ROLES for expression in role.key_space),
    key=lambda item: item[0].count("/"),
    reverse=True,
)
"""The narrowest first: the recorder's own alarms are among the keys that the monitor's expression names."""


@lru_cache(maxsize=MOST_CACHED)
def role_of_key(name: str) -> Role | None:
    """The role that may publish on a key; None if no role may.

    Args:
        name: the key below its plant.

    >>> [role_of_key(name).name for name in ("alarm/ewma/T", "alarm/recording/disk", "health/plant")]
    ['monitor', 'recorder', 'plant']
    >>> role_of_key("health/somebody") is None
    True
    """
    return next((role for expression, role in _KEY_SPACES if keys.matches(expression, name)), None)


def stream_of(key: str) -> str:
    """The stream that a key is in: root, plant and kind; and the role, where it does not publish all of the kind.

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
    """A key expression that holds all keys of a stream, and perhaps those of other roles.

    >>> keys_of("reactor/cstr/alarm/@recorder")
    'reactor/cstr/alarm/**'
    """
    return "/".join((*stream.split("/")[:STREAM_PARTS], "**"))
