"""Monitors that are started one after the other, each in place of one that was killed."""

from monitor_node.__main__ import MonitorNode
from monitor_node.config import MonitorConfig

_running: list[MonitorNode] = []


def start_node(config: MonitorConfig, start_ns: int) -> MonitorNode:
    """Start a monitor; those before are killed, with which their claims end."""
    while _running:
        file = _running.pop()._file
        if file is not None:
            file.claim.close()
    _running.append(MonitorNode(config, start_ns))
    return _running[-1]
