"""Catalogue of panels, in the order of their tabs.

A new panel is a file here that ends in `PANEL = Panel(title, draw)`, and a line in the tuple below.
"""

from recorder.panels import phase_plane, signals, status
from recorder.panels.base import Panel

PANELS: tuple[Panel, ...] = (
    signals.OVERVIEW,
    signals.CHARTS,
    status.ALARMS,
    signals.MODELS,
    phase_plane.PANEL,
    status.PROMISE,
    status.HEALTH,
)
