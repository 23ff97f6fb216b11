"""A log is a line an event: as text, or as a JSON object."""

import json
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from errno import ENOSPC
from io import StringIO
from pathlib import Path

import pytest
import structlog

from reactorwatch.runtime.node_main import LogFile, configure_log


def test_for_programs_each_line_is_an_object_with_the_fields_of_the_event(capsys: pytest.CaptureFixture[str]) -> None:
    configure_log(as_json=True)
    log = structlog.get_logger()
    log.info("alarm", alarm="ewma/T", value=3.5, file=Path("a.mcap"))
    log.warning("a second\nline")
    first, second = map(json.loads, capsys.readouterr().err.splitlines())
    said = datetime.fromisoformat(first.pop("timestamp"))
    assert said.tzinfo is not None
    assert abs(datetime.now(UTC) - said) < timedelta(minutes=1)
    assert first == {"event": "alarm", "level": "info", "alarm": "ewma/T", "value": 3.5, "file": "a.mcap"}
    assert (second["event"], second["level"]) == ("a second\nline", "warning")


def test_an_error_has_its_traceback_in_the_object(capsys: pytest.CaptureFixture[str]) -> None:
    configure_log(as_json=True)
    try:
        int("no")
    except ValueError:
        structlog.get_logger().exception("failed")
    (line,) = capsys.readouterr().err.splitlines()
    (error,) = json.loads(line)["exception"]
    assert not any(frame.get("locals") for frame in error["frames"])  # values may be private
    assert (error["exc_type"], error["exc_value"]) == ("ValueError", "invalid literal for int() with base 10: 'no'")


def test_for_people_it_is_a_line_of_text(capsys: pytest.CaptureFixture[str]) -> None:
    configure_log()
    structlog.get_logger().info("alarm", alarm="ewma/T")
    (line,) = capsys.readouterr().err.splitlines()
    assert "alarm=ewma/T" in line


class Disk(StringIO):
    """A file on a disk that may be full."""

    is_full = False

    def write(self, text: str) -> int:
        """Write, or fail."""
        if self.is_full:
            raise OSError(ENOSPC, "No space left on device")
        return super().write(text)


def test_lines_that_a_full_disk_refuses_are_counted_and_the_next_one_reports_it() -> None:
    disk = Disk()
    log = LogFile(disk)
    log.write("first\n")
    disk.is_full = True
    for _ in range(3):
        log.write("lost\n")
    disk.is_full = False
    log.write("second\n")
    log.write("third\n")
    said = "lines of the log that could not be written: 3"
    assert disk.getvalue().splitlines() == ["first", said, "second", "third"]


def test_a_process_whose_log_cannot_be_written_runs_to_its_own_end() -> None:
    program = (
        "import structlog; from reactorwatch.runtime.node_main import configure_log; configure_log(); "
        "[structlog.get_logger().info('row', n=n) for n in range(1000)]; raise SystemExit(7)"
    )
    with Path("/dev/full").open("wb") as full:
        assert subprocess.run([sys.executable, "-c", program], stderr=full, check=False).returncode == 7
