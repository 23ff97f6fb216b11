"""The process of a node: its log is a line an event, and an unexpected error ends it in one line and with its code."""

import errno
import json
import re
import runpy
import subprocess
import sys
import tempfile
from datetime import UTC, datetime, timedelta
from errno import ENOSPC
from io import StringIO
from pathlib import Path

import pytest
import structlog

from reactorwatch.errors import InputError
from reactorwatch.runtime.node_main import EXIT_CODE, LogFile, configure_log, print_error


def test_for_programs_each_line_is_an_object_with_the_fields_of_the_event(capsys: pytest.CaptureFixture[str]) -> None:
    configure_log(as_json=True)
    log = structlog.get_logger()
    log.info("alarm", alarm="ewma/T", value=3.5, file=Path("a.mcap"))
    log.warning("a second\nline")
    first, second = map(json.loads, capsys.readouterr().err.splitlines())
    stated = datetime.fromisoformat(first.pop("timestamp"))
    assert stated.tzinfo is not None
    assert abs(datetime.now(UTC) - stated) < timedelta(minutes=1)
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
    stated = "lines of the log that could not be written: 3"
    assert disk.getvalue().splitlines() == ["first", stated, "second", "third"]


def test_a_process_whose_log_cannot_be_written_runs_to_its_own_end() -> None:
    program = (
        "import structlog; from reactorwatch.runtime.node_main import configure_log; configure_log(); "
        "[structlog.get_logger().info('row', n=n) for n in range(1000)]; raise SystemExit(7)"
    )
    with Path("/dev/full").open("wb") as full:
        assert subprocess.run([sys.executable, "-c", program], stderr=full, check=False).returncode == 7


ROOT = Path(__file__).parents[3]
PACKAGES = ("reactorwatch", "plant_node", "monitor_node", "recorder", "diagnosis_node")
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__")
    for package in PACKAGES
    for path in (ROOT / package).rglob("*.py")
    if 'if __name__ == "__main__":' in path.read_text(encoding="utf-8")
)
ARGUMENTS = {
    "reactorwatch": ["record"],
    "diagnosis_node": ["settings.toml"],
    "recorder.tools.replay": ["settings.toml"],
}
ERRORS: dict[str, tuple[BaseException, int, str | None]] = {
    "a fault of ours": (
        RuntimeError("the wrong\nreactor\x1b[31m"),
        EXIT_CODE,
        r"the wrong reactor.*please send (\S+),",
    ),
    "a full disk": (OSError(errno.ENOSPC, "no room", "x.mcap"), 2, r"x\.mcap: no room$"),
    "an unusable setting": (InputError("no such\nreactor"), 2, r"no such reactor$"),
    "Ctrl-C": (KeyboardInterrupt(), 130, None),
}


def test_the_modules_are_those_that_the_documents_name() -> None:
    assert MODULES == [
        "diagnosis_node",
        "monitor_node",
        "plant_node",
        "reactorwatch",
        "reactorwatch.codegen",
        "recorder",
        "recorder.tools.replay",
    ]


@pytest.mark.parametrize("error", ERRORS)
@pytest.mark.parametrize("module", MODULES)
def test_an_error_within_a_node_process_is_one_line(
    module: str, error: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    raised, code, line = ERRORS[error]

    def fail(*_: object) -> None:
        raise raised

    monkeypatch.setattr("reactorwatch.runtime.bus_zenoh.connect", fail)
    monkeypatch.setattr("reactorwatch.cli.kernels.compile_kernels", fail)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    Path("settings.toml").write_text('[diagnosis]\nout = "reports"\n[replay]\nfile = "run.csv"\n')
    Path("run.csv").write_text("time_min,qc,C,T\n0,100,0.1,440\n1,101,0.1,440\n")
    monkeypatch.setattr(sys, "argv", [module, *ARGUMENTS.get(module, [])])
    for name in (module, f"{module}.__main__"):  # as in a process of its own, in which nothing has imported it
        if not hasattr(sys.modules.get(name), "__path__"):
            monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(module, run_name="__main__", alter_sys=False)
    assert ended.value.code == code
    *_, stated = ["", *capsys.readouterr().err.splitlines()]
    if line is None:
        assert "Traceback" not in stated
        return
    found = re.search(line, stated)
    assert found is not None, stated
    if code == EXIT_CODE:
        assert "\x1b" not in stated
        assert "Traceback (most recent call last)" in Path(found[1]).read_text(encoding="utf-8")


def test_a_complaint_is_one_line_whatever_is_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    print_error("recorder", "a\nb\x1b[31m\udcff")
    assert capsys.readouterr().err == "recorder: a b\\u001b[31m\\udcff\n"
