"""Catalogue of panels, in the order of their tabs.

A new panel is a file here that ends in `PANEL = Panel(title, draw)`, and a line in the tuple below.
"""

from recorder.panels import alarms, charts, health, model, overview, phase_plane, promise
from recorder.panels.base import Panel

PANELS: tuple[Panel, ...] = (
    overview.PANEL,
    charts.PANEL,
    alarms.PANEL,
    model.PANEL,
    phase_plane.PANEL,
    promise.PANEL,
    health.PANEL,
)
