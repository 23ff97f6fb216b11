"""Key expressions of the bus: built and parsed here only.

A key is `reactor/{plant}/{kind}/{name}`; the name of a chart point or an alarm may itself hold a slash
(`chart/ewma/T`, `alarm/ewma/T`).
"""

import itertools
import re
from functools import lru_cache
from typing import NamedTuple

ROOT = "reactor"
EVERYTHING = f"{ROOT}/**"

DEFAULT_PLANT = "cstr"
"""Name of a plant where none is stated."""

SAMPLE = "sample"
ESTIMATE = "estimate"
MODEL = "model"
CHART = "chart"
ALARM = "alarm"
ALARM_KPIS = "alarm_kpis"
INCIDENT = "incident"
RECONSTRUCTION = "reconstruction"
BASELINE = "baseline"
PROMISE = "promise"
HEALTH = "health"
FAULT = "fault"
COMMAND = "command"
AUDIT = "audit"
ALIVE = "alive"

BLOCKED = "blocked"
"""Phase of a node that waits at its start for what the machine refuses."""

RECORDING = "recording"
"""First part of the names of a recorder's own alarms; the recorder executes commands on them."""
LIST_RECORDER_ALARMS = "list_recorder_alarms"
ACKNOWLEDGE_RECORDER = "acknowledge_recorder"
"""The recorder's commands, different from the monitor's, so that a missing reply identifies the node."""

FLEET = "@fleet"
"""Key part in place of a plant, for messages between monitors that share a fleet. It is no plant's name, and no `*`
matches it."""

_PLANT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")

_SIGNAL = re.compile(r"[^@*$#?/\0][^*$#?/\0]*")

_SHARD = re.compile(r"([0-9]{1,4})/([0-9]{1,4})")

_PART = re.compile(r"\*\*?|(\$\*)?[^/*$#?\0]+(\$\*[^/*$#?\0]+)*(\$\*)?")


class Topic(NamedTuple):
    """Parts of a key."""

    plant: str
    kind: str
    name: str


def check_plant(plant: str) -> str:
    """Check that a plant's name can be part of a key and of a file name; returns it.

    Raises:
        ValueError: it holds characters with a meaning in key expressions or file names.
    """
    if not _PLANT.fullmatch(plant):
        raise ValueError(
            f"plant name must be 1 to 64 letters, digits, '_', '.' or '-', starting with a letter or digit, "
            f"got {plant!r}"
        )
    return plant


def check_signal(signal: str) -> str:
    """Check that samples of a signal can be published under its name; returns it.

    Raises:
        ValueError: it holds characters with a meaning in key expressions.
    """
    if not all(map(_SIGNAL.fullmatch, signal.split("/"))):
        raise ValueError(
            f"name of a published signal must not hold '*', '$', '#' or '?' or start with '@', got {signal!r}"
        )
    return signal


def check_expression(expression: str) -> str:
    """Check that a key expression is valid and canonical; returns it.

    Raises:
        ValueError: Zenoh would refuse it: a part is empty or holds '#', '?' or '$' (except in '$*'), '*' is next to a
            letter, or '**' is followed by '*' or '**'.
    """
    parts = expression.split("/")
    if not all(map(_PART.fullmatch, parts)) or any(
        before == "**" and after in ("*", "**") for before, after in itertools.pairwise(parts)
    ):
        raise ValueError(
            f"key_expression must be names with '/' between, in which '*' stands for one name, '**' for any number of "
            f"them and '$*' for any letters, such as '{EVERYTHING}', got {expression!r}"
        )
    return expression


def key(plant: str, kind: str, name: str) -> str:
    """Build a key, such as `reactor/cstr/sample/T`.

    >>> key("cstr", SAMPLE, "T")
    'reactor/cstr/sample/T'
    """
    return f"{ROOT}/{plant}/{kind}/{name}"


def chart_name(chart: str, signal: str) -> str:
    """Name of a signal's chart in keys of chart points and alarms: `shewhart/T`."""
    return f"{chart}/{signal}"


def all_keys(plant: str, kind: str) -> str:
    """Key expression of all of one kind of one plant, such as `reactor/cstr/sample/**`."""
    return f"{ROOT}/{plant}/{kind}/**"


def parse(text: str) -> Topic | None:
    """Parse a key; None if it has another form.

    >>> parse("reactor/cstr/chart/shewhart/T")
    Topic(plant='cstr', kind='chart', name='shewhart/T')
    >>> parse("weather/today") is None
    True
    """
    parts = text.split("/", 3)
    if len(parts) != 4 or parts[0] != ROOT or not all(parts):
        return None
    return Topic(*parts[1:])


def monitor_token(plant: str, name: str) -> str:
    """Liveliness token by which monitors of a plant detect each other, in addition to that of their node.

    Args:
        plant: name of the plant.
        name: unique name of the monitor; `*`: the key expression of all.
    """
    return instance_token(plant, "monitor", name)


def instance_token(plant: str, node: str, name: str) -> str:
    """Liveliness token of one instance of a node, in addition to that of the node, by which a second one finds it.

    >>> instance_token("cstr", "recorder", "0f3a9c21.4711@pi4")
    'reactor/cstr/alive/@recorder/0f3a9c21.4711@pi4'

    Args:
        plant: name of the plant.
        node: name of the node.
        name: unique name of the instance, with its process and host; `*`: the key expression of all.
    """
    return key(plant, ALIVE, f"@{node}/{name}")


def fleet_token(plants: str, of: str, number: str, name: str) -> str:
    """Liveliness token of a fleet's monitor.

    >>> fleet_token("reactor/north_*", "5", "2", "0f3a9c21.4711@pi4")
    'reactor/@fleet/alive/north_+/5/2/0f3a9c21.4711@pi4'

    Args:
        plants: key expression of the fleet's plants. A key cannot hold its `*`, which `+` replaces.
        of: count of shards.
        number: number of the monitor's shard.
        name: unique name of the instance, with its process and host.
    """
    return f"{ROOT}/{FLEET}/{ALIVE}/{plants.removeprefix(f'{ROOT}/').replace('*', '+')}/{of}/{number}/{name}"


FLEET_TOKENS = f"{ROOT}/{FLEET}/{ALIVE}/*/*/*/*"
"""Key expression of the tokens of all monitors of all fleets."""


class FleetToken(NamedTuple):
    """Parts of the token of a fleet's monitor, see `fleet_token`."""

    plants: str
    of: str
    number: str
    name: str


def parse_fleet_token(token: str) -> FleetToken | None:
    """Parse the token of a fleet's monitor; None if it has another form.

    >>> parse_fleet_token(fleet_token("reactor/*", "5", "2", "a"))
    FleetToken(plants='reactor/*', of='5', number='2', name='a')
    """
    root, _, rest = token.partition(f"/{FLEET}/{ALIVE}/")
    parts = rest.split("/")
    if root != ROOT or len(parts) != 4 or not all(parts):
        return None
    try:
        return FleetToken(check_plants(f"{ROOT}/{parts[0].replace('+', '*')}"), *parts[1:])
    except ValueError:
        return None


def parse_shard(text: str) -> tuple[int, int]:
    """Number and count of a shard in its text form.

    >>> parse_shard("2/5")
    (2, 5)

    Raises:
        ValueError: the text is no shard.
    """
    match = _SHARD.fullmatch(text)
    number, of = (int(match[1]), int(match[2])) if match is not None else (0, 0)
    if not 1 <= number <= of <= 1000:
        raise ValueError(f"shard must be like 2/5, the second of five, with at most 1000, got {text!r}")
    return number, of


def samples_of(plants: str) -> str:
    """Key expression of the samples of all plants that an expression such as `reactor/*` matches."""
    return f"{plants}/{SAMPLE}/**"


def check_plants(expression: str) -> str:
    """Check the key expression of a set of plants; returns it.

    Raises:
        ValueError: it is not `reactor/` and one name, in which `*` matches any letters.
    """
    root, _, name = expression.partition("/")
    if root != ROOT or not re.fullmatch(r"[A-Za-z0-9_.*-]+", name) or "**" in name:
        raise ValueError(
            f"plants must be {ROOT}/ and a name with or without '*', such as '{ROOT}/*' or '{ROOT}/north_*', "
            f"got {expression!r}"
        )
    return expression


def matches(key_expression: str, key: str) -> bool:
    """Match a key with a key expression: `*` matches letters of one part, `**` any number of parts.

    No `*` matches a part that starts with `@`.

    >>> matches("reactor/*/sample/**", "reactor/cstr/sample/T"), matches("reactor/**", "reactor")
    (True, True)
    >>> matches("reactor/**", "reactor/@fleet/alive/1")
    False
    """
    return _pattern(key_expression).fullmatch("/" + key) is not None


@lru_cache(maxsize=256)
def _pattern(key_expression: str) -> re.Pattern[str]:
    pattern = ""
    for part in key_expression.split("/"):
        if part == "**":
            pattern += "(/[^/@][^/]*)*"
        else:
            first, *others = part.split("*")
            pattern += (
                "/"
                + re.escape(first)
                + "".join(
                    ("[^/]*" if first or number else "(?!@)[^/]*") + re.escape(piece)
                    for number, piece in enumerate(others)
                )
            )
    return re.compile(pattern)
