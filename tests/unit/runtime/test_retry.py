"""Transient errors are waited for at a node's start, and permanent ones are raised at once."""

import errno
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor_node.config import MonitorConfig
from monitor_node.node import MonitorNode
from monitor_node.state_files import StateStore
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Health
from reactorwatch.errors import InputError, UnavailableError, is_passing
from reactorwatch.records.write import atomic_write, make_folder
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal, retry
from reactorwatch.runtime.http_pages import LOOPBACK
from reactorwatch.runtime.start import GONE_WITHIN_S, claim_name, instance_name, wait_ready
from recorder.config import RecorderConfig
from recorder.node import RecorderNode
from recorder.recording_files import RecordingFiles
from tests.memory_bus import Exchange, MemoryBus
from tests.running import WITHIN_S

PASSING = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO, errno.EMFILE)
"""Errors of the system about a folder."""
LASTING = (errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP)

TOKEN = "reactor/cstr/alive/@recorder/"


def write_atomically(folder: Path) -> None:
    with atomic_write(folder / "file") as temporary:
        temporary.write_text("text")


def start_recorder(out: Path) -> None:
    config = RecorderConfig(out=str(out))
    with RecordingFiles(config) as files:
        RecorderNode(config, files, 0)


STARTS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "a folder to make": ("mkdir", lambda folder: make_folder(folder / "new", "--out")),
    "a file to write": ("touch", write_atomically),
    "a recorder's folder to make": ("mkdir", lambda folder: start_recorder(folder / "new")),
    "a recorder's folder to list": ("iterdir", start_recorder),
    "a recorder's first file": ("open", start_recorder),
    "a recorder's only file": ("open", lambda folder: start_recorder(folder / "run.mcap")),
    "a fleet's folder to make": ("mkdir", lambda folder: StateStore(make_folder(folder / "new"))),
    "a fleet's folder to list": ("iterdir", StateStore),
    "a monitor's state": ("read_bytes", lambda path: MonitorNode(MonitorConfig(state_file=str(path / "state")), 0)),
}
"""Calls of the system that a node makes on a folder at its start, and the function that makes each."""


@pytest.mark.parametrize("number", PASSING + LASTING, ids=errno.errorcode.get)
@pytest.mark.parametrize("start", STARTS)
def test_what_the_system_refuses_a_starting_node_passes_or_not_by_its_kind_wherever_it_is_met(
    start: str, number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "state").write_bytes(b"")
    call, run = STARTS[start]
    real = getattr(Path, call)

    def refuse(path: Path, *arguments: object, **options: object) -> object:
        if path.is_relative_to(tmp_path):
            raise OSError(number, os.strerror(number), str(path))
        return real(path, *arguments, **options)

    monkeypatch.setattr(Path, call, refuse)
    with pytest.raises((InputError, OSError)) as refused:
        run(tmp_path)
    assert is_passing(refused.value) == (number in PASSING)


@given(st.lists(st.sampled_from(["a", "b"]), max_size=6), st.booleans())
def test_a_passing_state_is_tried_again_until_it_has_passed_with_a_line_for_each_new_reason(
    reasons: list[str], is_lasting: bool
) -> None:
    left, lines, waited = list(reasons), list[str](), list[float]()

    def attempt() -> str:
        if left:
            raise InputError(left.pop(0)) from OSError(errno.ENOSPC, "No space left on device")
        if is_lasting:
            raise InputError("a typo")
        return "started"

    def wait(seconds: float) -> bool:
        waited.append(seconds)
        return False

    def start() -> str | None:
        return retry(attempt, wait, lambda why, is_new: lines.append(why) if is_new else None)

    if is_lasting:
        with pytest.raises(InputError, match="a typo"):
            start()
    else:
        assert start() == "started"
    assert lines == [now for before, now in zip(["", *reasons], reasons, strict=False) if now != before]
    pauses = [seconds for seconds in waited if seconds]
    assert pauses == [min(0.1 * 2**number, 2.0) for number in range(len(reasons))]


def test_health_reports_what_a_node_waits_for_and_a_stop_ends_the_wait_at_once() -> None:
    exchange, stop, heard = Exchange(), StopSignal(), list[Encoded]()
    MemoryBus(exchange).subscribe("reactor/cstr/health/*", heard.append)

    def attempt() -> None:
        if heard:
            stop.set()
        raise PermissionError(errno.EACCES, "Permission denied", "/recordings")

    assert wait_ready(attempt, MemoryBus(exchange), "recorder", "cstr", stop) is None
    health = decode(heard[0].payload, heard[0].encoding)
    assert isinstance(health, Health)
    assert (health.node, health.phase) == ("recorder", "blocked")
    assert health.waiting_for == "/recordings: Permission denied"


@pytest.mark.parametrize(
    ("endpoint", "passes"),
    [
        ("tcp/127.0.0.1:{taken}", True),
        ("tcp/192.0.2.1:7447", True),  # of a network for documents: no machine has it
        ("tcp/[2001:db8::1]:7447", True),
        ("tcp/127.0.0.1:port", False),
        ("tcp/127.0.0.1", False),
        ("carrier-pigeon/127.0.0.1:7447", False),
    ],
)
def test_an_address_that_is_taken_or_not_there_yet_can_pass_and_a_wrong_one_cannot(
    endpoint: str, passes: bool, tmp_path: Path
) -> None:
    file = tmp_path / "router.json5"
    with socket.create_server((LOOPBACK, 0)) as taken:
        address = endpoint.format(taken=taken.getsockname()[1])
        file.write_text(f'{{mode: "router", listen: {{endpoints: ["{address}"]}}}}')
        starts: tuple[Callable[[], object], ...] = (
            lambda: bus_zenoh.router(BusConfig(address)),
            lambda: bus_zenoh.router_from_file(file),
        )
        for start in starts:
            with pytest.raises(ValueError, match=r"address|endpoint|port|router") as refused:
                start()
            assert is_passing(refused.value) == passes


# --- one instance of a name --------------------------------------------------------------------------------------


def test_the_name_of_an_instance_holds_its_process_and_is_another_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "line 2/*.works")
    assert instance_name().endswith(f".{os.getpid()}@line-2--.works")
    assert instance_name() != instance_name()


def test_a_second_instance_ends_and_names_the_process_and_host_of_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reactorwatch.runtime.start.GONE_WITHIN_S", 0.1)
    exchange = Exchange()
    first, second = MemoryBus(exchange), MemoryBus(exchange)
    assert claim_name(first, "recorder", f"{TOKEN}a.12@pi4", StopSignal())
    assert claim_name(second, "recorder", "reactor/other/alive/@recorder/b.13@pi5", StopSignal())
    assert claim_name(second, "monitor", "reactor/cstr/alive/@monitor/b.13@pi5", StopSignal())
    said = "another recorder of plant 'cstr' is alive, as process 12 on pi4: stop one of them"
    with pytest.raises(UnavailableError, match=said):
        claim_name(second, "recorder", f"{TOKEN}b.13@pi5", StopSignal())
    assert [key for _, key in exchange.tokens if key.startswith(TOKEN)] == [f"{TOKEN}a.12@pi4"]


def test_a_restart_waits_for_the_end_of_the_lease_of_the_one_that_died() -> None:
    assert GONE_WITHIN_S > bus_zenoh.LEASE_S
    exchange, stop = Exchange(), StopSignal()
    dead = MemoryBus(exchange)
    dead.declare_token(f"{TOKEN}a.12@pi4")

    class Looking(MemoryBus):
        def query_tokens(self, key_expression: str) -> list[str]:
            found = super().query_tokens(key_expression)
            dead.close()  # its lease ends after the first look
            return found

    assert claim_name(Looking(exchange), "recorder", f"{TOKEN}b.13@pi4", stop)


def test_a_stop_ends_the_wait_for_a_name() -> None:
    exchange, stop = Exchange(), StopSignal()
    MemoryBus(exchange).declare_token(f"{TOKEN}a.12@pi4")
    stop.set()
    assert not claim_name(MemoryBus(exchange), "recorder", f"{TOKEN}b.13@pi4", stop)


def test_of_instances_that_start_at_once_one_remains(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reactorwatch.runtime.start.LOOK_AGAIN_S", (0.0, 0.01))
    exchange, stop = Exchange(), StopSignal()
    won, together = list[int](), threading.Barrier(4)
    one = threading.Event()

    def start(number: int) -> None:
        together.wait()
        if claim_name(MemoryBus(exchange), "recorder", f"{TOKEN}{number}.{number}@pi4", stop):
            won.append(number)
            one.set()

    threads = [threading.Thread(target=start, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    assert one.wait(WITHIN_S)
    stop.set()
    for thread in threads:
        thread.join()
    assert len(won) == 1
    assert [key for _, key in exchange.tokens] == [f"{TOKEN}{won[0]}.{won[0]}@pi4"]
