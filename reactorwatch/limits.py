"""Bounds of files that a user names or another program wrote, and the readers of TOML and JSON that keep them.

Each bound is checked before the work that it bounds: a few kilobytes can otherwise ask for hours or for all memory. No
file that a plant needs comes near one; the table `[limits]` of the settings raises them.
"""

import re
import tomllib
from typing import Annotated, Any

import msgspec

from reactorwatch.errors import InputError

_MOST, _DEEPEST = 1_000_000_000, 500  # deeper documents exhaust the stack of the library
_Count = Annotated[int, msgspec.Meta(ge=1, le=_MOST)]


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Bounds of files.

    Attributes:
        file_bytes: size of a file that describes a process, of a model (`extended.json`) and of settings, in bytes.
        depth: depth to which tables and lists may be nested in TOML and JSON.
        key_characters: characters of a key in TOML and JSON, with the dots of a dotted one.
        missing: number of cells that mean "not measured".
        effects: number of effects and laws of an extended model. Each is added to the equations with those before it,
            so that ten times as many take a hundred times as long: 1,000 a few seconds.
        equations: number of steps that compute stored equations, and of their variables of each kind.
    """

    file_bytes: _Count = 10_000_000
    depth: Annotated[int, msgspec.Meta(ge=1, le=_DEEPEST)] = 50
    key_characters: _Count = 256
    missing: _Count = 1_000
    effects: _Count = 1_000
    equations: _Count = 10_000

    def __post_init__(self) -> None:
        for name, value in msgspec.structs.asdict(self).items():
            largest = _DEEPEST if name == "depth" else _MOST
            if not 1 <= value <= largest:
                raise ValueError(f"{name} must be in [1, {largest:g}], got {value:g}")

    def check(self, limit: str, what: str, number: int) -> None:
        """Check a number.

        Args:
            limit: name of the limit.
            what: what was counted, for the message.
            number: the number.

        Raises:
            InputError: it is larger than the limit.
        """
        if number > (largest := getattr(self, limit)):
            raise InputError(
                f"{what} must be at most {largest}, got {number}; {limit} in [limits] of the settings raises this"
            )


_in_force = [Limits()]


def limits() -> Limits:
    """Limits of this process."""
    return _in_force[0]


def set_limits(given: Limits) -> None:
    """Set the limits of this process."""
    _in_force[0] = given


_PART = r"""(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_TOKEN = re.compile(
    rf"""\#[^\n]*+
    |\"\"\"(?:[^"\\]|\\.|"(?!""))*+(?:\"\"\")?
    |'''(?:[^']|'(?!''))*+(?:''')?
    |(?P<key>{_PART}(?P<dotted>(?:[ \t]*+\.[ \t]*+{_PART}){{2,}}+)?)""",
    re.VERBOSE | re.DOTALL,
)
"""Comments, texts of several lines, and keys or texts of one line. Numbers look like keys with at most one dot."""


def parse_toml(content: bytes) -> dict[str, Any]:
    """Parse a TOML document, with or without a byte order mark.

    Raises:
        InputError: it is not TOML, or exceeds the limits.
    """
    limits().check("file_bytes", "size in bytes", len(content))
    try:
        text = content.decode("utf-8-sig")
        for token in _TOKEN.finditer(text):  # the library's time grows with the square of a dotted key
            if token["dotted"]:
                _check_key(token["key"])
        tables = tomllib.loads(text)
    except RecursionError as error:
        raise _too_deep() from error
    except InputError:
        raise
    except ValueError as error:  # not TOML, not UTF-8, or a number of thousands of digits
        raise InputError(f"is not TOML: {error}") from error
    _check_tree(tables)
    return tables


def parse_json(content: bytes | str) -> Any:
    """Parse a JSON document.

    Raises:
        InputError: it is not JSON, or exceeds the limits.
    """
    limits().check("file_bytes", "size in bytes", len(content))
    try:
        tree = msgspec.json.decode(content)
    except RecursionError as error:
        raise _too_deep() from error
    except (msgspec.DecodeError, UnicodeError) as error:
        raise InputError(f"is not JSON: {error}") from error
    _check_tree(tree)
    return tree


def _check_tree(tree: Any) -> None:
    """Check depth and keys, one depth after the other."""
    level, depth = [tree], 0
    while level := [item for item in level if isinstance(item, dict | list)]:
        depth += 1
        if depth > limits().depth:
            raise _too_deep()
        for item in level:
            for key in item if isinstance(item, dict) else ():
                _check_key(key)
        level = [child for item in level for child in (item.values() if isinstance(item, dict) else item)]


def _check_key(key: str) -> None:
    limits().check("key_characters", f"the number of characters of the key {key[:20]!r}...", len(key))


def _too_deep() -> InputError:
    largest = limits().depth
    return InputError(f"must be nested at most {largest} deep, got more; depth in [limits] of the settings raises this")
