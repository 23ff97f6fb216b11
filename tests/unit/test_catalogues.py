"""Every file of a family is in its catalogue, and every file of a catalogue's folder is of the family."""

from pathlib import Path

import pytest

import reactorwatch.process.library.cstr.effects
import reactorwatch.spc.charts
import recorder.panels
from reactorwatch.spc.charts.catalogue import CHARTS
from recorder.panels.base import Panel

FAMILIES = {
    "effects": (
        reactorwatch.process.library.cstr.effects,
        {type(e).__module__ for e in reactorwatch.process.library.cstr.effects.EFFECTS},
    ),
    "charts": (reactorwatch.spc.charts, {chart.__module__ for chart in CHARTS}),
    "panels": (recorder.panels, {panel.draw.__module__ for panel in recorder.panels.PANELS}),
}


@pytest.mark.parametrize("family", FAMILIES)
def test_every_file_of_the_folder_is_listed(family: str) -> None:
    package, listed = FAMILIES[family]
    assert package.__file__ is not None
    files = {path.stem for path in Path(package.__file__).parent.glob("*.py")} - {"__init__", "base", "catalogue"}
    assert {name.rpartition(".")[2] for name in listed} == files


def test_names_in_a_catalogue_differ() -> None:
    for names in (
        [effect.name for effect in reactorwatch.process.library.cstr.effects.EFFECTS],
        [chart.name for chart in CHARTS],
        [panel.title for panel in recorder.panels.PANELS if isinstance(panel, Panel)],
    ):
        assert len(set(names)) == len(names)
