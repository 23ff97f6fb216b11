"""Alarms that the charts of a plant can raise, by its settings."""

from monitor_node.config import MonitorConfig
from reactorwatch.spc.charts.base import SignalChart
from reactorwatch.spc.charts.catalogue import chart
from reactorwatch.spc.joint_chart import JointChart
from reactorwatch.spc.value_chart import ValueChart

ALL = "all"
"""Name in place of a signal for charts of all outputs together."""

SUBSTITUTES = ("shewhart", "ewma")
"""Charts of each output that are made where the settings have charts of values only, and none of them can be made."""


def alarm_names(config: MonitorConfig) -> list[tuple[str, str]]:
    """(chart, signal or `ALL`) of every alarm that the charts of a plant can raise."""
    names: list[tuple[str, str]] = []
    for name in config.charts:
        kind = chart(name)
        if issubclass(kind, SignalChart):
            names += [(name, signal) for signal in config.outputs]
        elif issubclass(kind, ValueChart) or (issubclass(kind, JointChart) and len(config.outputs) > 1):
            names.append((name, ALL))
    if has_values_only(config):
        names += [(name, signal) for name in SUBSTITUTES for signal in config.outputs]
    return names


def has_values_only(config: MonitorConfig) -> bool:
    """True if all charts of the settings are of values, so that there may be none after a training."""
    return all(issubclass(chart(name), ValueChart) for name in config.charts)


def count_chance_alarms(config: MonitorConfig) -> int:
    """Number of the charts' alarms that share the false alarms, with every signal monitored; see `ValueChart`."""
    of_settings = [pair for pair in alarm_names(config) if pair[0] in config.charts]
    return sum(len(config.signals) if issubclass(chart(name), ValueChart) else 1 for name, _ in of_settings)
