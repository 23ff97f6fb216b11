"""The key expressions of the bus: built here, taken apart here, and nowhere else.

A key is `reactor/{plant}/{kind}/{name}`; the name of a chart point or an alarm may itself hold a slash
(`chart/ewma/T`, `alarm/ewma/T`).
"""

import re
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

_PLANT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


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
