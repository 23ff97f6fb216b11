"""The key expressions of the bus: built here, taken apart here, and nowhere else.

A key is `reactor/{plant}/{kind}/{name}`; the name of a chart point or an alarm may itself hold a slash
(`chart/ewma/T`, `alarm/ewma/T`).
"""

import itertools
import re
from functools import lru_cache
from typing import NamedTuple

ROOT = "reactor"
EVERYTHING = f"{ROOT}/**"

SAMPLE = "sample"
ESTIMATE = "estimate"
MODEL = "model"
CHART = "chart"
ALARM = "alarm"
ALARM_KPIS = "alarm_kpis"
RECONSTRUCTION = "reconstruction"
HEALTH = "health"
FAULT = "fault"
COMMAND = "command"
AUDIT = "audit"
ALIVE = "alive"

RECORDING = "recording"
"""What the names of a recorder's own alarms begin with: no monitor raises them, and the recorder answers for them."""
LIST_RECORDER_ALARMS = "list_recorder_alarms"
ACKNOWLEDGE_RECORDER = "acknowledge_recorder"
"""The recorder's commands; others than the monitor's, so that it is known whether each of the two is there."""

FLEET = "@fleet"
"""In place of a plant: what monitors that share a fleet tell each other. No plant is called so; no `*` reaches it."""

_PLANT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")

_PART = re.compile(r"\*\*?|(\$\*)?[^/*$#?\0]+(\$\*[^/*$#?\0]+)*(\$\*)?")


class Topic(NamedTuple):
    """A key taken apart."""

    plant: str
    kind: str
    name: str


def checked_plant(plant: str) -> str:
    """The plant's name, if it can be part of a key.

    Raises:
        ValueError: a name with characters that a key expression or a file name could take for something else.
    """
    if not _PLANT.fullmatch(plant):
        raise ValueError(
            f"plant name must be 1 to 64 letters, digits, '_', '.' or '-', starting with a letter or digit, "
            f"got {plant!r}"
        )
    return plant


def checked_expression(expression: str) -> str:
    """A key expression, if it is one in canonical form.

    Raises:
        ValueError: Zenoh would refuse it: a part is empty or holds '#', '?' or '$' (but in '$*'), or '*' is beside a
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
    """The key of one thing of one plant, such as `reactor/cstr/sample/T`.

    >>> key("cstr", SAMPLE, "T")
    'reactor/cstr/sample/T'
    """
    return f"{ROOT}/{plant}/{kind}/{name}"


def chart_name(chart: str, signal: str) -> str:
    """The name of a chart of a signal, in keys of chart points and of alarms: `shewhart/T`."""
    return f"{chart}/{signal}"


def all_of(plant: str, kind: str) -> str:
    """The key expression of everything of one kind of one plant, such as `reactor/cstr/sample/**`."""
    return f"{ROOT}/{plant}/{kind}/**"


def parse(text: str) -> Topic | None:
    """Take a key apart; None if it is not one of ours.

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
    """The liveliness token by which monitors of a plant notice each other, beside that of their node.

    Args:
        plant: its name.
        name: of the monitor, unlike any other's; `*`: the key expression of all.
    """
    return key(plant, ALIVE, f"@monitor/{name}")


def fleet_token(fleet: str, of: str, number: str, name: str) -> str:
    """The liveliness token of one of the monitors that share a fleet.

    Args:
        fleet: what they share, as one part of a key.
        of: how many shards it has.
        number: of the monitor's shard.
        name: of the monitor, as `fleet_member` makes it.
    """
    return f"{ROOT}/{FLEET}/{ALIVE}/{fleet}/{of}/{number}/{name}"


FLEET_TOKENS = fleet_token("*", "*", "*", "*")
"""The key expression of the tokens of all monitors of all fleets."""


def fleet_member(name: str, plants: str) -> str:
    """The name of a fleet's monitor in its token, from which others see which plants the fleet watches.

    >>> fleet_member("01", "reactor/north_*")
    '01@north_+'

    Args:
        name: of the monitor, unlike any other's.
        plants: the key expression of the fleet's plants. A key cannot hold its `*`, so `+` stands for it.
    """
    return f"{name}@{plants.removeprefix(f'{ROOT}/').replace('*', '+')}"


class FleetToken(NamedTuple):
    """The token of a monitor of a fleet, taken apart; see `fleet_token`."""

    fleet: str
    of: str
    number: str
    name: str

    @property
    def plants(self) -> str:
        """The key expression of the fleet's plants; empty if the token does not say it."""
        expression = f"{ROOT}/{self.name.partition('@')[2].replace('+', '*')}"
        try:
            return checked_plants(expression)
        except ValueError:
            return ""


def parse_fleet_token(token: str) -> FleetToken | None:
    """Take the token of a monitor of a fleet apart; None if it is not one.

    >>> parse_fleet_token(fleet_token("0f", "5", "2", "a"))
    FleetToken(fleet='0f', of='5', number='2', name='a')
    """
    root, _, rest = token.partition(f"/{FLEET}/{ALIVE}/")
    parts = rest.split("/")
    if root != ROOT or len(parts) != 4 or not all(parts):
        return None
    return FleetToken(*parts)


def samples_of(plants: str) -> str:
    """The key expression of the samples of all plants that an expression such as `reactor/*` is of."""
    return f"{plants}/{SAMPLE}/**"


def checked_plants(expression: str) -> str:
    """The key expression of a set of plants, if it is one.

    Raises:
        ValueError: it is not `reactor/` and one name, in which `*` stands for any letters.
    """
    root, _, name = expression.partition("/")
    if root != ROOT or not re.fullmatch(r"[A-Za-z0-9_.*-]+", name) or "**" in name:
        raise ValueError(
            f"plants must be {ROOT}/ and a name with or without '*', such as '{ROOT}/*' or '{ROOT}/north_*', "
            f"got {expression!r}"
        )
    return expression


def matches(key_expression: str, key: str) -> bool:
    """Match a key with a key expression: `*` stands for letters of one part, `**` for any number of parts.

    No `*` stands for a part that begins with `@`.

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
