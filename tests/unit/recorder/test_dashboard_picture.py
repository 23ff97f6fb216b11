"""Pictures of dashboards. They need Rerun's viewer and a graphics driver; without these the tests are skipped."""

import io
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from docs.pictures.picture import count_coloured, render_tabs
from reactorwatch.errors import InputError
from recorder.columns import read_run
from recorder.panels.base import ALARM, INPUT, MEASURED, PREDICTED, RESIDUAL, UNSTABLE, Colour, Series, TimePlot
from recorder.view.file import write_rrd, write_views
from tests.unit.recorder import golden


@contextmanager
def skipping_without_graphics() -> Iterator[None]:
    try:
        yield
    except InputError as error:
        if "needs a graphics driver" in str(error):
            pytest.skip(str(error))
        raise


def like(pixels: NDArray[np.int16], colour: Colour) -> NDArray[np.bool_]:
    """Which pixels are of a colour, smoothed edges left out."""
    return np.asarray(np.abs(pixels - np.array(colour)).max(axis=2) <= 40)


def pixels_of(png: Path) -> NDArray[np.int16]:
    with Image.open(png) as image:
        return np.asarray(image.convert("RGB"), np.int16)


@pytest.fixture(scope="module")
def rrd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("picture") / "run.rrd"
    write_rrd(read_run(golden.entries()), path)
    return path


@pytest.fixture(scope="module")
def drawn(rrd: Path) -> tuple[list[Path], list[subprocess.Popen[bytes]]]:
    """The pictures of all tabs, and the viewers that were started for them."""
    started: list[subprocess.Popen[bytes]] = []

    def start(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        started.append(real(*arguments, **options))
        return started[-1]

    real = subprocess.Popen
    with pytest.MonkeyPatch.context() as patch, skipping_without_graphics():
        patch.setattr(subprocess, "Popen", start)
        pictures = render_tabs(rrd, rrd.with_name("tabs"), 1000, 700)
    return pictures, started


def test_a_picture_shows_the_lines_and_leaves_no_viewer_behind(
    drawn: tuple[list[Path], list[subprocess.Popen[bytes]]],
) -> None:
    pictures, started = drawn
    pixels = pixels_of(pictures[0])
    assert pixels.shape == (700, 1000, 3)
    for colour in (MEASURED, PREDICTED, INPUT):
        there = like(pixels, colour)
        assert there.sum() > 150
        assert np.ptp(np.flatnonzero(there.any(axis=0))) > 450, "the whole run is shown, over the width of the plots"
    (viewer,) = started
    assert viewer.returncode is not None
    assert isinstance(viewer.args, list)
    assert viewer.args[viewer.args.index("--bind") + 1] == "127.0.0.1"


def test_every_tab_gets_a_picture_of_its_own(drawn: tuple[list[Path], list[subprocess.Popen[bytes]]]) -> None:
    pictures, _ = drawn
    assert [path.name for path in pictures] == [
        "overview.png", "residuals-and-charts.png", "alarms.png", "phase-plane.png", "health.png",
    ]  # fmt: skip
    shown = {path.stem: pixels_of(path) for path in pictures}
    # residuals, the alarm's lane and line, the path and the steady states, and a node's lane
    for tab, colour, least in (
        ("residuals-and-charts", RESIDUAL, 500),
        ("alarms", ALARM, 100),
        ("phase-plane", MEASURED, 500),
        ("phase-plane", UNSTABLE, 20),
        ("health", INPUT, 1000),
    ):
        assert like(shown[tab], colour).sum() > least, tab
    for tab, colour in (("residuals-and-charts", MEASURED), ("alarms", MEASURED), ("health", ALARM)):
        assert like(shown[tab], colour).sum() < 50, tab


@pytest.mark.parametrize("views", [(1,), (3,)], ids=str)
def test_a_single_tab_of_any_number_of_views_gets_a_picture(tmp_path: Path, views: tuple[int, ...]) -> None:
    """A single tab, with a single view in it, too; of several see above."""
    time_ns = np.arange(100) * 60_000_000_000
    lines = [Series("x", time_ns, np.sin(time_ns / 1e12), colour, width=4.0) for colour in (MEASURED, ALARM, INPUT)]
    tabs = {
        f"Tab {number}": [TimePlot(f"{number}.{view}", "K", (lines[number],)) for view in range(count)]
        for number, count in enumerate(views)
    }
    write_views(tabs, tmp_path / "run.rrd", 0)
    with skipping_without_graphics():
        pictures = render_tabs(tmp_path / "run.rrd", tmp_path / "tabs", 800, 500)
    assert [path.name for path in pictures] == [f"tab-{number}.png" for number in range(len(views))]
    for path, line in zip(pictures, lines, strict=False):
        assert like(pixels_of(path), line.colour).sum() > 150, path.name


def test_only_coloured_pixels_count() -> None:
    image = Image.new("RGB", (10, 10), (120, 120, 120))
    image.paste(MEASURED, (0, 0, 10, 3))
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    assert count_coloured(buffer.getvalue()) == 30


def test_a_file_that_cannot_be_drawn_is_reported_in_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such file"):
        render_tabs(tmp_path / "none.rrd", tmp_path / "tabs")
    (tmp_path / "run.rrd").write_bytes(b"")
    with pytest.raises(InputError, match="the viewer did not show the plots in time"):
        render_tabs(tmp_path / "run.rrd", tmp_path / "tabs", deadline_s=0.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.rrd"]
