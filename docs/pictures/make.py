"""Makes the pictures of README and docs from real runs, and the page docs/study.md with its own: `make pictures`.

Needs a graphics driver that works without a screen; on Debian: mesa-vulkan-drivers libegl1 libgl1 libxkbcommon-x11-0.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from recorder.picture import render_png

FOLDER = Path(__file__).parent


def main() -> int:
    """Make the study, run the demonstration and draw it; returns an exit code."""
    command = str(Path(sys.executable).with_name("reactorwatch"))
    study = subprocess.run([command, "reproduce", "-o", str(FOLDER.parent)], check=False)  # noqa: S603 (our own command)
    if study.returncode:
        return study.returncode
    with tempfile.TemporaryDirectory() as temporary:
        run = Path(temporary) / "run"
        demo = [command, "demo", "--out", str(run), "--speed", "max"]
        done = subprocess.run(demo, check=False)  # noqa: S603 (as above)
        if done.returncode:
            return done.returncode
        render_png(run / "demo.rrd", FOLDER / "dashboard.png", width=1600, height=1000)
    return 0


if __name__ == "__main__":
    sys.exit(main())
