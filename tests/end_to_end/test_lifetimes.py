"""Start and end of processes: transient causes are waited for, and no process outlives its supervisor."""

import errno
import fcntl
import os
import re
import signal
import socket
import subprocess
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Health
from reactorwatch.runtime.bus_zenoh import ZenohBus, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.http_pages import LOOPBACK, free_endpoint
from reactorwatch.runtime.start import GONE_WITHIN_S
from tests.running import mount_small_disk

from .conftest import PATIENCE_S, REACTORWATCH, WaitAlive

RECORDER, MONITOR, PLANT = ("record", "-o", "out"), ("monitor", "--state", "out"), ("plant",)
FLEET = ("monitor", "--plants", "reactor/*", "--state", "out")
TOKENS = {RECORDER: "recorder", MONITOR: "monitor", PLANT: "plant"}


class Running:
    """A process, its log line by line, and its terminal if it has one.

    Args:
        folder: folder that it runs in.
        arguments: arguments of `reactorwatch`.
        has_terminal: give it a terminal of its own; else none, in a session of its own.
        command: runs in place of `reactorwatch`.
    """

    def __init__(
        self, folder: Path, *arguments: str, has_terminal: bool = False, command: tuple[str, ...] = (REACTORWATCH,)
    ) -> None:
        self._shown, self._changed = "", threading.Condition()
        self.screen, theirs = os.openpty() if has_terminal else os.pipe()

        def begin() -> None:
            signal.signal(signal.SIGHUP, signal.SIG_DFL)  # tests may run under nohup
            if has_terminal:
                fcntl.ioctl(1, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            [*command, *arguments],
            stdin=theirs if has_terminal else subprocess.DEVNULL,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            preexec_fn=begin,
            cwd=folder,
        )
        os.close(theirs)
        self._reader = threading.Thread(target=self._read, args=(os.dup(self.screen),), daemon=True)
        self._reader.start()

    def _read(self, screen: int) -> None:
        try:
            while read := os.read(screen, 65536):
                with self._changed:
                    self._shown += read.decode(errors="replace")
                    self._changed.notify_all()
        except OSError:
            pass  # its terminal was closed
        finally:
            os.close(screen)

    def wait_for(self, pattern: str) -> str:
        """Wait until a line matches, and return it."""
        with self._changed:
            found = self._changed.wait_for(lambda: re.search(f".*{pattern}.*", self._shown), PATIENCE_S)
            assert found, f"{pattern!r} was not logged: {self._shown}"
            return found[0]

    def count(self, pattern: str) -> int:
        with self._changed:
            return len(re.findall(pattern, self._shown))

    def end(self, number: int = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.process.wait(PATIENCE_S)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        if self.screen >= 0:
            os.close(self.screen)


Run = Callable[..., Running]


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """Run `reactorwatch` with arguments in the test's folder; it is ended with the test."""
    running: list[Running] = []

    def begin(*arguments: str, **options: object) -> Running:
        running.append(Running(tmp_path, *arguments, **options))  # type: ignore[arg-type]
        return running[-1]

    yield begin
    for item in running:
        item.close()


class Reports:
    """Health on a bus, by node."""

    def __init__(self, bus: ZenohBus) -> None:
        self._newest, self._changed = dict[str, Health](), threading.Condition()
        bus.subscribe(keys.all_keys("cstr", keys.HEALTH), self._on_message)

    def _on_message(self, message: Encoded) -> None:
        health = decode(message.payload, message.encoding)
        assert isinstance(health, Health)
        with self._changed:
            self._newest[health.node] = health
            self._changed.notify_all()

    def wait(self, node: str, wanted: Callable[[Health], bool]) -> Health:
        with self._changed:
            assert self._changed.wait_for(lambda: node in self._newest and wanted(self._newest[node]), PATIENCE_S), (
                f"{node}: {self._newest.get(node)}"
            )
            return self._newest[node]


# --- what can pass -----------------------------------------------------------------------------------------------

REFUSING = """
import os, sys
from pathlib import Path

number, marker, folder = int(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]).absolute()
real = {name: getattr(Path, name) for name in ("mkdir", "iterdir", "open", "touch")}

def refusing(name):
    def call(path, *arguments, **options):
        if os.path.exists(marker) and path.absolute().is_relative_to(folder):
            raise OSError(number, os.strerror(number), str(path))
        return real[name](path, *arguments, **options)
    return call

for name in real:
    setattr(Path, name, refusing(name))
sys.argv = ["reactorwatch", *sys.argv[4:]]
from reactorwatch.cli.main import main
main()
"""
"""`reactorwatch` on a machine that refuses a folder as long as a marker is there."""


@pytest.mark.slow
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES], ids=errno.errorcode.get)
@pytest.mark.parametrize("command", [RECORDER, MONITOR, FLEET], ids=" ".join)
def test_a_folder_that_the_machine_refuses_is_waited_for_and_reported_in_a_line_and_in_health(
    command: tuple[str, ...], number: int, tmp_path: Path, run: Run, bus: ZenohBus, endpoint: str, wait_alive: WaitAlive
) -> None:
    marker, reports = tmp_path / "refused", Reports(bus)
    marker.touch()
    program = (sys.executable, "-c", REFUSING, str(number), str(marker), str(tmp_path / "out"))
    node = run(*command, "--endpoint", endpoint, command=program)
    said = node.wait_for(os.strerror(number))
    assert "waiting" in said
    if command in TOKENS:
        health = reports.wait(TOKENS[command], lambda health: health.phase == "blocked")
        assert os.strerror(number) in health.waiting_for
        marker.unlink()
        wait_alive("cstr", TOKENS[command])
        reports.wait(TOKENS[command], lambda health: not health.waiting_for and health.phase != "blocked")
    else:
        marker.unlink()
        node.wait_for("listening")
    assert node.count(os.strerror(number)) == 1
    assert node.end() == 0


@pytest.mark.slow
@pytest.mark.parametrize("command", [RECORDER, MONITOR, FLEET], ids=" ".join)
def test_a_stop_ends_the_wait_for_a_folder_at_once(
    command: tuple[str, ...], tmp_path: Path, run: Run, bus: ZenohBus, endpoint: str
) -> None:
    marker = tmp_path / "refused"
    marker.touch()
    program = (sys.executable, "-c", REFUSING, str(errno.EROFS), str(marker), str(tmp_path / "out"))
    node = run(*command, "--endpoint", endpoint, command=program)
    node.wait_for("Read-only")
    assert node.end() == 0


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    with mount_small_disk(tmp_path / "out", "64k") as folder:
        yield folder


@pytest.mark.slow
@pytest.mark.parametrize("command", [RECORDER, MONITOR], ids=" ".join)
def test_a_disk_that_is_full_at_the_start_ends_no_node_and_health_reports_it(
    command: tuple[str, ...], small_disk: Path, run: Run, bus: ZenohBus, endpoint: str, wait_alive: WaitAlive
) -> None:
    """A monitor watches meanwhile; a recorder has nothing to do."""
    ballast, reports = small_disk / "ballast", Reports(bus)
    with ballast.open("wb", buffering=0) as file:
        while file.tell() < os.statvfs(small_disk).f_blocks * os.statvfs(small_disk).f_frsize:
            file.write(bytes(1024))
    node = run(*command, "--endpoint", endpoint)
    node.wait_for("No space left")
    reports.wait(TOKENS[command], lambda health: "No space left" in health.waiting_for)
    ballast.unlink()
    wait_alive("cstr", TOKENS[command])
    reports.wait(TOKENS[command], lambda health: not health.waiting_for)
    assert node.end() == 0
    assert list(small_disk.glob("*.mcap")) or (small_disk / "monitor.state").stat().st_size


def test_a_router_waits_for_its_port_and_a_stop_ends_the_wait(run: Run) -> None:
    with socket.create_server((LOOPBACK, 0)) as taken:
        endpoint = f"tcp/{LOOPBACK}:{taken.getsockname()[1]}"
        first, second = (run("router", "--endpoint", endpoint) for _ in range(2))
        for waiting in (first, second):
            waiting.wait_for("waiting.*Address already in use")
        assert second.end() == 0
    first.wait_for(r"\] router ")
    assert first.count("waiting") == 1
    assert first.end() == 0


@pytest.mark.slow
def test_a_metrics_port_that_is_taken_stops_no_node(run: Run, bus: ZenohBus, endpoint: str, tmp_path: Path) -> None:
    pytest.importorskip("prometheus_client", reason="prometheus-client (reactorwatch[metrics]) is not installed")
    from tests.ports import three_free_ports

    port, reports = three_free_ports(), Reports(bus)
    (tmp_path / "settings.toml").write_text(
        f'[bus]\nendpoint = "{endpoint}"\n[metrics]\nport = {port}\n'
        + "".join(f"[{table}]\nhealth_period_s = 0.2\n" for table in ("plant", "monitor", "recorder"))
    )
    taken = [socket.create_server((LOOPBACK, port + offset)) for offset in range(3)]
    nodes = {name: run(*command, "--config", "settings.toml") for command, name in TOKENS.items()}
    for name in nodes:
        reports.wait(name, lambda health: f"[metrics] port {port}" in health.waiting_for)
    for server in taken:
        server.close()
    for name, node in nodes.items():
        reports.wait(name, lambda health: not health.waiting_for and health.uptime_s > 0)
        node.wait_for("metrics.*page=http")
        assert node.count("cannot listen") == 1
        assert node.end() == 0


# --- a terminal that is closed -----------------------------------------------------------------------------------


def started(command: tuple[str, ...], node: Running, wait_alive: WaitAlive) -> None:
    """Wait until a node, or a router, has started."""
    if command in TOKENS:
        wait_alive("cstr", TOKENS[command])
    else:
        node.wait_for("endpoint|listening")


NODES = [PLANT, MONITOR, RECORDER, FLEET, ("router",)]


@pytest.mark.slow
@pytest.mark.parametrize("how", ["its terminal is closed", "a signal"])
@pytest.mark.parametrize("command", NODES, ids=" ".join)
def test_a_hangup_ends_a_node_that_has_a_terminal_as_a_stop_does(
    command: tuple[str, ...], how: str, tmp_path: Path, run: Run, wait_alive: WaitAlive, endpoint: str
) -> None:
    at = free_endpoint() if command == ("router",) else endpoint
    node = run(*command, "--endpoint", at, has_terminal=True)
    started(command, node, wait_alive)
    if how == "a signal":
        node.process.send_signal(signal.SIGHUP)
    else:
        os.close(node.screen)
        node.screen = -1
        os.kill(node.process.pid, signal.SIGHUP)  # as the kernel, once the last reader has closed its end
    assert node.process.wait(PATIENCE_S) == 0
    assert not list(tmp_path.glob("out/*.part"))
    assert len(list(tmp_path.glob("out/*.mcap"))) == (command == RECORDER)


@pytest.mark.slow
@pytest.mark.parametrize("command", NODES, ids=" ".join)
def test_a_node_without_a_terminal_ignores_a_hangup(
    command: tuple[str, ...], run: Run, wait_alive: WaitAlive, endpoint: str, bus: ZenohBus
) -> None:
    at = free_endpoint() if command == ("router",) else endpoint
    node = run(*command, "--endpoint", at)
    started(command, node, wait_alive)
    node.process.send_signal(signal.SIGHUP)
    if command in TOKENS:  # it goes on
        reports = Reports(bus)
        first = reports.wait(TOKENS[command], lambda _: True)
        reports.wait(TOKENS[command], lambda health: health.time_ns > first.time_ns)
    assert node.process.poll() is None
    assert node.end() == 0


@pytest.mark.slow
@pytest.mark.parametrize("has_terminal", [True, False], ids=["in a terminal", "without one"])
@pytest.mark.parametrize("command", ["up", "demo"])
def test_a_hangup_ends_up_and_demo_as_a_stop_does_with_their_files_finished(
    command: str, has_terminal: bool, tmp_path: Path, run: Run, endpoint: str
) -> None:
    options = ("--endpoint", endpoint) if command == "up" else ("--speed", "1")
    supervisor = run(command, "--out", "out", *options, has_terminal=has_terminal)
    wait_until_recorded(tmp_path, supervisor)
    nodes = children(supervisor)
    assert len(nodes) == 3
    if has_terminal:
        os.close(supervisor.screen)
        supervisor.screen = -1
    assert supervisor.end(signal.SIGHUP) == 0
    assert not list(filter(is_running, nodes))
    assert not list(tmp_path.glob("out/*.part"))
    assert len(list(tmp_path.glob("out/*.mcap"))) == 1


# --- a supervisor that dies --------------------------------------------------------------------------------------


def children(supervisor: Running) -> list[int]:
    """Numbers of the processes that it started, in whatever thread."""
    tasks = Path(f"/proc/{supervisor.process.pid}/task")
    return [int(number) for task in tasks.iterdir() for number in (task / "children").read_text().split()]


def is_running(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until_recorded(folder: Path, supervisor: Running) -> None:
    """Wait until a recorder has written a message of each node."""
    waited = threading.Event()
    for _ in range(round(PATIENCE_S / 0.05)):
        if any(b"sample/T" in path.read_bytes() for path in folder.glob("out/*.part")) or any(
            path.stat().st_size > 20_000 for path in folder.glob("out/*.part")
        ):
            return
        assert supervisor.process.poll() is None, "it ended by itself"
        waited.wait(0.05)
    raise AssertionError("nothing was recorded")


@pytest.mark.slow
def test_nodes_end_with_a_supervisor_that_was_killed_and_the_next_has_one_of_each(
    tmp_path: Path, run: Run, endpoint: str
) -> None:
    first = run("up", "--out", "out", "--endpoint", endpoint, "--speed", "60")
    wait_until_recorded(tmp_path, first)
    nodes = children(first)
    assert len(nodes) == 3
    ends = [os.pidfd_open(number) for number in nodes]
    first.process.kill()
    first.process.wait()
    second = run("up", "--out", "again", "--endpoint", endpoint, "--speed", "60")  # at once
    for end in ends:
        import select

        assert select.select([end], [], [], PATIENCE_S)[0], "a node lives on"
        os.close(end)
    assert not list(tmp_path.glob("out/*.part"))
    assert len(list(tmp_path.glob("out/*.mcap"))) == 1
    second.wait_for("listening")
    assert second.end() == 0
    assert len(list(tmp_path.glob("again/*.mcap"))) == 1


# --- one instance of a name --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_second_instance_of_a_node_ends_and_names_the_first_which_continues(
    run: Run, bus: ZenohBus, endpoint: str, wait_alive: WaitAlive, tmp_path: Path
) -> None:
    """All at once: each waits until the lease of one that died would have ended."""
    first = {name: run(*command, "--endpoint", endpoint) for command, name in TOKENS.items()}
    wait_alive("cstr", *first)
    second = {name: run(*command, "--endpoint", endpoint) for command, name in TOKENS.items()}
    for name, node in second.items():
        node.wait_for("another is alive: waiting for its end")
        assert node.process.wait(GONE_WITHIN_S + PATIENCE_S) == 1
        said = (
            f"another {name} of plant 'cstr' is alive, as process {first[name].process.pid} on {socket.gethostname()}"
        )
        node.wait_for(said)
    assert all(node.process.poll() is None for node in first.values())
    assert len(list(tmp_path.glob("out/*.part"))) == 1
    for node in first.values():
        assert node.end() == 0


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_a_node_that_is_started_again_after_one_that_died_takes_its_place(
    how: signal.Signals, run: Run, bus: ZenohBus, endpoint: str, wait_alive: WaitAlive
) -> None:
    """One that is frozen is dead for others when its lease has ended, as one on a machine without power."""
    first = run(*PLANT, "--endpoint", endpoint)
    wait_alive("cstr", "plant")
    first.process.send_signal(how)
    second = run(*PLANT, "--endpoint", endpoint)
    reports = Reports(bus)
    health = reports.wait("plant", lambda health: health.uptime_s > 0)
    newer = reports.wait("plant", lambda newest: newest.time_ns > health.time_ns)
    assert newer.phase == "running"
    assert second.end() == 0


@pytest.mark.slow
def test_monitors_of_two_shards_of_a_fleet_run_beside_each_other(run: Run, bus: ZenohBus, endpoint: str) -> None:
    nodes = [
        run("monitor", "--plants", "reactor/*", "--shard", shard, "--endpoint", endpoint) for shard in ("1/2", "2/2")
    ]
    for node in nodes:
        node.wait_for("listening")
    for node in nodes:
        assert node.process.poll() is None
        assert node.end() == 0


def test_a_router_that_is_there_ends_up_at_once(run: Run, endpoint: str) -> None:
    """A person is in front of it, and may choose another address."""
    with closing(router(BusConfig(endpoint=endpoint))):
        supervisor = run("up", "--endpoint", endpoint, "--out", "out")
        assert supervisor.process.wait(PATIENCE_S) == 2
        supervisor.wait_for("is another router running there")
