"""A monitor that is killed resumes where it was: the alarms equal those of one that never stopped."""

from pathlib import Path
from typing import Any

import pytest

from monitor_node.replay.verification import verify
from reactorwatch.api.files import open_messages

from .live_run import PLANT, LiveRun

KILLS_MIN = (8.0, 20.0)
"""In training, and watching; the third kill comes while the alarms of the leak stand."""
LOOKS = 3
"""Looks for causes heard before that kill; other messages of the same row are then still on their way."""


def looks(run: LiveRun) -> int:
    """Number of looks for causes whose suspects were heard."""
    return len({tuple(map(str, incident.suspects)) for incident in run.incidents if incident.suspects})


@pytest.mark.slow
def test_three_kills_change_no_alarm(tmp_path: Path) -> None:
    """What was published while it was down, and since it was stored, the plant tells it once more.

    The recording replays, value for value, as that of a monitor that was never stopped.
    """
    state: dict[str, Any] = {"state_file": str(tmp_path / "monitor.state"), "state_every_s": 0.5}
    with LiveRun(tmp_path, duration_min=90.0, speed=240.0, **state) as run:
        monitor, plant = run.start_all()
        for kill in range(1 + len(KILLS_MIN)):
            if kill < len(KILLS_MIN):
                run.wait_until(KILLS_MIN[kill])
            else:
                run.wait(lambda: looks(run) >= LOOKS)
                run.wait_until_recorded()
            run.kill("monitor", monitor)
            monitor = run.start("monitor")
            assert "the monitor resumes from it" in (tmp_path / "monitor.log").read_text(encoding="utf-8")
        run.end(plant)
        assert (run.health.lost, run.health.late, run.health.incomplete_rows) == (0, 0, 0)
        assert run.recorded_alarms() == run.expected_alarms()
        assert verify(lambda: open_messages(run.recording, PLANT).messages, run.monitor).exact
