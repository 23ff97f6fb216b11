"""Pictures of dashboards. They need Rerun's viewer and a graphics driver; without these the tests skip and say so."""

import io
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from reactorwatch.errors import InputError
from recorder.panels.base import MEASURED, PREDICTED, RESIDUAL
from recorder.picture import count_coloured, render_png
from recorder.rerun_file import write_rrd
from recorder.run import read_run
from tests.unit.recorder import golden


def test_a_picture_shows_the_lines_and_leaves_no_viewer_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    def start(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        started.append(real(*arguments, **options))
        return started[-1]

    real = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", start)
    rrd, png = tmp_path / "run.rrd", tmp_path / "run.png"
    write_rrd(read_run(golden.entries()), rrd)
    try:
        render_png(rrd, png, 1000, 700)
    except InputError as error:
        if "needs a graphics driver" in str(error):
            pytest.skip(str(error))
        raise
    with Image.open(png) as image:
        assert image.size == (1000, 700)
        pixels = np.asarray(image.convert("RGB"), np.int16)
    for colour in (MEASURED, PREDICTED, RESIDUAL):
        like = np.abs(pixels - np.array(colour)).max(axis=2) <= 30
        columns = np.flatnonzero(like.any(axis=0))
        assert like.sum() > 150
        assert np.ptp(columns) > 450, "the whole run is shown, over the width of the plots"
    (viewer,) = started
    assert viewer.returncode is not None
    assert isinstance(viewer.args, list)
    assert viewer.args[viewer.args.index("--bind") + 1] == "127.0.0.1"


def test_only_coloured_pixels_count() -> None:
    image = Image.new("RGB", (10, 10), (120, 120, 120))
    image.paste(MEASURED, (0, 0, 10, 3))
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    assert count_coloured(buffer.getvalue()) == 30


def test_what_cannot_be_drawn_is_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such file"):
        render_png(tmp_path / "none.rrd", tmp_path / "run.png")
    (tmp_path / "run.rrd").write_bytes(b"")
    with pytest.raises(InputError, match=r"the folder .+ does not exist"):
        render_png(tmp_path / "run.rrd", tmp_path / "no" / "run.png")
    with pytest.raises(InputError, match="the viewer did not show the plots in time"):
        render_png(tmp_path / "run.rrd", tmp_path / "run.png", deadline_s=0.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.rrd"]
