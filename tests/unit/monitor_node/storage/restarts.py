"""Monitors that are started one after the other, each in place of one that was killed."""

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.node import MonitorNode

_running: list[MonitorNode] = []


def start_node(config: MonitorConfig, start_ns: int) -> MonitorNode:
    """Start a monitor; those before are killed, with which their claims end."""
    while _running:
        states = _running.pop()._states
        if states is not None:
            states.claim.close()
    _running.append(MonitorNode(config, start_ns))
    return _running[-1]


def own(node: MonitorNode) -> Monitor:
    """Monitor of the only plant."""
    (plant,) = node.plants
    return node.monitor(plant)
