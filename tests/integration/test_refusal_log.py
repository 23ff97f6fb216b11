"""The router of a site logs what it refuses, at a bounded rate."""

import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.bus import Bus
from reactorwatch.runtime.bus_zenoh import connect
from reactorwatch.runtime.bus_zenoh.sessions import LOG_EVERY_NS, RefusalLog
from reactorwatch.runtime.event_loop import StopSignal

from .site import WITHIN_S, make, settings

PUBLISH_EVERY_S = 0.5
KINDS = ("Query", "Reply", "Put", "Delete", "Declare/Undeclare Subscriber", "Declare/Undeclare Queryable")


def decision(verdict: str, what: str, key: str) -> bytes:
    who = "2f on Interface(lo)+CertCommonName(cstr.viewer)+Transport(Tls)+2f"
    return (
        f"TRACE rx-0 ThreadId(7) zenoh::net::routing::interceptor::access_control: {who} is {verdict} to {what} on "
        f"{key}".encode()
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


def test_other_lines_are_passed_to_standard_output() -> None:
    assert not RefusalLog().add(b"ERROR zenoh: something else")


def test_decisions_that_a_router_makes_in_advance_are_no_refusals_and_later_messages_by_them_are() -> None:
    refusals = RefusalLog()
    caching = b"TRACE rx-0 ThreadId(7) zenoh::access_control: ACL (ingress): caching permissions for `reactor/a` ..."
    kept = b"TRACE rx-1 ThreadId(8) zenoh::access_control: Using cached result: 2f is unauthorized to Put (ingress) on "
    for line in (caching, *(decision("unauthorized", f"{what} (ingress)", "reactor/a") for what in KINDS)):
        refusals.add(line)
    assert refusals.report(0) is None
    refusals.add(kept + b"reactor/a")
    assert refusals.report(0) == "refused: Put by cstr.viewer on reactor/a; 1 refusals since the last line, 1 in all"
    refusals.add(decision("unauthorized", "Put (ingress)", "reactor/a"))
    assert refusals.report(LOG_EVERY_NS) is not None


@pytest.mark.slow
def test_nodes_and_people_that_keep_to_their_rights_cause_no_refusal(tmp_path: Path) -> None:
    make(tmp_path / "site")
    command = [sys.executable, "-m", "reactorwatch"]
    router = subprocess.Popen(
        [*command, "up", "--site", "site"], stderr=subprocess.PIPE, text=True, cwd=tmp_path, start_new_session=True
    )
    overdue = threading.Timer(2 * WITHIN_S, router.kill)
    overdue.start()
    lines: list[str] = []
    try:
        assert router.stderr is not None
        for line in router.stderr:
            lines.append(line)
            if "listening" in line:  # the monitor, which is the last
                break
        for typed in (
            "status --once --config site/cstr/viewer/settings.toml",
            "doctor --config site/cstr/operator/settings.toml",
            "doctor --config site/cstr/plant/settings.toml",
            "alarm shelve shewhart/T --minutes 1 --by me --config site/cstr/operator/settings.toml",
            "baseline list --config site/cstr/engineer/settings.toml",
        ):
            done = subprocess.run([*command, *typed.split()], cwd=tmp_path, capture_output=True, timeout=WITHIN_S)
            assert done.returncode == 0, (typed, done.stdout, done.stderr)
    finally:
        overdue.cancel()
        router.send_signal(signal.SIGINT)
        lines += router.communicate(timeout=WITHIN_S)[1].splitlines()
    assert not [line for line in lines if "refused" in line]


WITHOUT_NODES = (
    "from reactorwatch.cli.main import main; from reactorwatch.cli.processes import Processes; "
    "Processes.start = lambda *_: None; main()"
)


def publish_until(bus: Bus, end: threading.Event) -> None:
    """Publish again and again: what is sent before a subscriber is known, or as its session closes, may be lost."""
    while not end.is_set():
        bus.publish(Encoded("reactor/cstr/sample/T", b"made up", ""))
        end.wait(PUBLISH_EVERY_S)


@pytest.mark.parametrize(
    ("typed", "code"), [("router site/router/router.json5", 0), ("up --site site", 0), ("demo --site site -o new", 130)]
)
def test_every_command_that_is_the_router_of_a_site_logs_the_client_and_the_key_that_it_refused(
    tmp_path: Path, typed: str, code: int
) -> None:
    """The nodes of `up` and `demo` are left out."""
    make(tmp_path / "site", plants=("cstr", "demo"))
    is_logged = threading.Event()
    router = subprocess.Popen(
        [sys.executable, "-c", WITHOUT_NODES, *typed.split()], stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    overdue = threading.Timer(WITHIN_S, router.kill)  # its log ends, and so does the wait for a line
    overdue.start()
    try:
        viewer, recorder = (
            connect(settings(tmp_path / "site", f"cstr/{role}"), role, StopSignal()) for role in ("viewer", "recorder")
        )
        assert viewer is not None
        assert recorder is not None
        recorder.subscribe("reactor/cstr/sample/*", lambda _: None)  # Zenoh sends nothing that nobody subscribes to
        publisher = threading.Thread(target=publish_until, args=(viewer, is_logged))
        publisher.start()
        try:
            assert router.stderr is not None
            assert any("refused: Put by cstr.viewer on reactor/cstr/sample/T" in line for line in router.stderr)
        finally:
            is_logged.set()
            publisher.join()
            viewer.close()
            recorder.close()
    finally:
        overdue.cancel()
        router.send_signal(signal.SIGINT)
        router.communicate(timeout=WITHIN_S)
    assert router.returncode == code
