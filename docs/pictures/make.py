"""Makes the pictures of README and docs from real runs, and the page docs/study.md with its own: `make pictures`.

Needs a graphics driver that works without a screen; on Debian: mesa-vulkan-drivers libegl1 libgl1 libxkbcommon-x11-0.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from docs.pictures.picture import render_tabs

FOLDER = Path(__file__).parent
COLOURS = 255
"""Of a picture, rare ones kept: a dashboard has few, and the file becomes a third."""


def main() -> int:
    """Make the study, run the demonstration and draw it; returns an exit code."""
    command = [str(Path(sys.executable).with_name("reactorwatch"))]
    study = [sys.executable, "-m", "benchmarks.study_figures"]
    with tempfile.TemporaryDirectory() as temporary:
        run, tabs = Path(temporary) / "run", Path(temporary) / "tabs"
        recording, diagnosis = run / "demo.mcap", run / "diagnosis"
        for program, *arguments in (
            (study, "--out", FOLDER.parent),
            (command, "demo", "--out", run),
            (command, "dashboard", recording, "-o", run / "demo.rrd", "--diagnosis", diagnosis),
        ):
            done = subprocess.run([*program, *map(str, arguments)], check=False)  # noqa: S603 (our own command)
            if done.returncode:
                return done.returncode
        for picture in sorted(render_tabs(run / "demo.rrd", tabs)):
            with Image.open(picture) as image:
                image.convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE).save(
                    FOLDER / picture.name, optimize=True
                )
    return 0


if __name__ == "__main__":
    sys.exit(main())
