"""The router of a site says in its log what it refuses, without being flooded itself."""

import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.bus_zenoh import connect
from reactorwatch.runtime.bus_zenoh.refusal_log import LOG_EVERY_NS, RefusalLog
from reactorwatch.runtime.event_loop import StopSignal

from .site import WITHIN_S, make, settings


def decision(verdict: str, what: str, key: str) -> bytes:
    who = "2f on Interface(lo)+CertCommonName(cstr.viewer)+Transport(Tls)+2f"
    return (
        f"TRACE rx-0 zenoh::net::routing::interceptor::access_control: {who} is {verdict} to {what} on {key}".encode()
    )


def test_of_a_flood_of_refusals_a_line_a_second_is_logged_and_all_are_counted() -> None:
    refusals, lines = RefusalLog(), list[str]()
    for number in range(10_000):
        assert refusals.add(decision("unauthorized", "Put (ingress)", "reactor/cstr/sample/T"))
        line = refusals.report(number * LOG_EVERY_NS // 1000)
        lines += [line] if line is not None else []
    assert len(lines) == 10
    assert lines[-1].endswith("1000 refusals since the last line, 9001 in all")


@pytest.mark.parametrize(
    "line",
    [
        decision("authorized", "Put (ingress)", "reactor/cstr/sample/T"),
        decision("unauthorized", "Put (egress)", "reactor/cstr/sample/T"),
        decision("unauthorized", "Delete (ingress)", "reactor/cstr"),
    ],
)
def test_what_is_no_refusal_of_a_message_is_not_logged_and_not_printed(line: bytes) -> None:
    refusals = RefusalLog()
    assert refusals.add(line)
    assert refusals.report(0) is None


def test_other_lines_go_on_to_standard_output() -> None:
    assert not RefusalLog().add(b"ERROR zenoh: something else")


WITHOUT_NODES = (
    "from reactorwatch.cli.main import main; from reactorwatch.cli.processes import Processes; "
    "Processes.start = lambda *_: None; main()"
)


@pytest.mark.parametrize(
    ("typed", "code"), [("router site/router/router.json5", 0), ("up --site site", 0), ("demo --site site -o new", 130)]
)
def test_every_command_that_is_the_router_of_a_site_logs_whom_it_refused_what(
    tmp_path: Path, typed: str, code: int
) -> None:
    """The nodes of `up` and `demo` are left out."""
    make(tmp_path / "site", plants=("cstr", "demo"))
    router = subprocess.Popen(
        [sys.executable, "-c", WITHOUT_NODES, *typed.split()], stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    overdue = threading.Timer(WITHIN_S, router.kill)  # its log ends, and so does the wait for a line
    overdue.start()
    try:
        viewer = connect(settings(tmp_path / "site", "cstr/viewer"), "viewer", StopSignal())
        assert viewer is not None
        viewer.publish(Encoded("reactor/cstr/sample/T", b"made up", ""))
        viewer.close()
        assert router.stderr is not None
        assert any("refused: Put by cstr.viewer on reactor/cstr/sample/T" in line for line in router.stderr)
    finally:
        overdue.cancel()
        router.send_signal(signal.SIGINT)
        router.communicate(timeout=WITHIN_S)
    assert router.returncode == code
