"""The catalogue of panels, in the order in which they are laid out.

A new panel is a file here that ends in `PANEL = Panel(title, draw)`, and a line in the tuple below.
"""

from recorder.panels import alarms, phase_plane, residuals, signals
from recorder.panels.base import Panel

PANELS: tuple[Panel, ...] = (
    signals.PANEL,
    residuals.PANEL,
    phase_plane.PANEL,
    alarms.PANEL,
)
