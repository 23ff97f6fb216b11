"""Live dashboard of a running plant: messages of the bus, streamed to a viewer.

The viewer is a process of its own and stores the data; memory here does not grow with the run. The set of views becomes
known in the first seconds of a run, so the layout is sent again with each new view.
"""

import errno
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple

import rerun as rr

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode, encoding_of
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.loopback import free_port
from recorder.columns.run_reader import SEGMENT_MESSAGES, RunReader
from recorder.dashboard.history_query import HistoryQuery, RunHistory, query_history, zero_of
from recorder.dashboard.renderer import Renderer
from recorder.dashboard.stream import APPLICATION
from recorder.dashboard.viewer_process import describe_exit, viewer
from recorder.panels import PANELS

_ALARM = encoding_of(Alarm)

NODE = "view"
SCREENS = ("WAYLAND_DISPLAY", "WAYLAND_SOCKET", "DISPLAY")  # those that winit reads
CLEAN_EXIT_CODES = (
    None,
    0,
    130,
    -signal.SIGINT,
    -signal.SIGTERM,
)  # running, closed, or terminated together with this process
LOOPBACK = ("127.0.0.1", "::1")
DRAW_INTERVAL_NS = 500_000_000
ZERO_TIMEOUT_NS = 15_000_000_000
"""Three times the usual period of health reports."""
START_TIMEOUT_S = 30.0
POLL_S = 0.1
MAX_REMEMBERED = 10_000
"""Stored changes of alarms, so that a listed one is not target twice."""


class DisplayTarget(NamedTuple):
    """Target of a dashboard: a window, or a web page; `port` is that of the page, None for a free one."""

    web: bool
    bind: str
    port: int | None


def show(
    plant: str,
    bus_config: BusConfig,
    target: DisplayTarget,
    say: Callable[[str], None],
    process: Process | None = None,
) -> None:
    """Show a plant until the viewer is closed, or SIGINT (Ctrl-C) or SIGTERM comes.

    Args:
        plant: name of the plant.
        bus_config: settings of the bus.
        target: window or web page.
        say: called with the address of the web page.
        process: process of the plant; None: unknown.

    Raises:
        InputError: the viewer does not run on this machine, its address or port is unavailable, or the endpoint is
            invalid.
    """
    if not target.web:
        _check_screen(sys.platform, os.environ)
    page, data = (free_port(), free_port()) if target.port is None else (target.port, target.port + 1)
    for port in (page, data):
        _check_free(target.bind, port)
    arguments = ("--serve-web", "--web-viewer-port", str(page), *_origins(target, page)) if target.web else ()
    with tempfile.TemporaryDirectory() as folder, stop_on_signals() as stop:
        log = Path(folder) / "viewer.log"
        with viewer(*arguments, port=data, bind=target.bind, log=log) as child:
            _wait_for(child, data, target, log)
            if target.web:
                _wait_for(child, page, target, log)  # it is served some time after the data
                host = _in_url(_reachable_address(target.bind))
                say(f"open http://{host}:{page}/?url=rerun%2Bhttp://{host}:{data}/proxy")
            threading.Thread(target=_stop_with, args=(child, stop), name="viewer", daemon=True).start()
            bus = bus_zenoh.connect(bus_config, NODE, stop)
            if bus is None:
                if child.poll() not in CLEAN_EXIT_CODES:
                    raise _exit_error(child.returncode, target, log)
                return
            try:
                recording = stream_to(data, target.bind, f"{plant}-{time.time_ns()}")
                past = query_history(bus, plant)
                query = HistoryQuery(lambda: query_history(bus, plant), past.answered)
                now_ns = time.time_ns()
                dashboard = LiveDashboard(recording, lambda: child.poll() is not None, now_ns, past, query, process)
                loop = EventLoop(dashboard, bus, stop)
                loop.subscribe(f"{keys.ROOT}/{plant}/**", history_s=bus_config.history_s)
                loop.subscribe_liveliness(keys.all_keys(plant, keys.ALIVE), on_token=dashboard.on_alive)
                loop.run()
                recording.disconnect()
            finally:
                bus.close()


class LiveDashboard:
    """Draws received messages; see `reactorwatch.runtime.event_loop.Node`.

    Args:
        recording: stream to a viewer.
        is_closed: returns True once the viewer is closed.
        now_ns: clock reading.
        past: history of the run before the subscription.
        query: repeats the query for alarms when a node appears; None never repeats it.
        process: process of the plant; None: unknown.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        is_closed: Callable[[], bool],
        now_ns: int,
        past: RunHistory = RunHistory(),  # noqa: B008 (it is frozen)
        query: HistoryQuery | None = None,
        process: Process | None = None,
    ) -> None:
        self._recording = recording
        self._is_closed = is_closed
        self._drawing = Renderer(recording)
        self._reader = RunReader(past.zero_ns, process)
        self._has_zero = past.zero_ns is not None
        # a fleet's monitor stores no health report: the next one holds the zero
        self._zero_within_ns = now_ns + (ZERO_TIMEOUT_NS if not self._has_zero and "monitor" in past.answered else 0)
        self._query = query
        self._known = dict.fromkeys(map(_change, past.alarms))
        self._count = len(past.alarms)
        for message in past.alarms:
            self._reader.add(message)
        self._next_ns = now_ns + DRAW_INTERVAL_NS

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Collect a message until the next drawing."""
        if self._is_known(message):
            return []  # it was listed before
        if now_ns < self._zero_within_ns and not self._has_zero and (zero_ns := zero_of(message)) is not None:
            self._reader.set_zero(zero_ns)
            self._has_zero = True
        self._take(message)
        if self._count >= SEGMENT_MESSAGES or now_ns >= self._next_ns:
            self._draw(now_ns)
        return []

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Never called: a dashboard declares no commands."""
        raise AssertionError(question.key)

    def on_alive(self, token: str, is_alive: bool, _now_ns: int) -> list[Publication]:
        """Query a node that appears for its alarms."""
        if self._query is not None:
            self._query.on_alive(token, is_alive)
        return []

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Draw the collected messages."""
        for past in self._query.answers() if self._query is not None else ():
            for message in past.alarms:
                if not self._is_known(message):
                    self._take(message)
        self._draw(now_ns)
        return []

    def next_tick_ns(self) -> int:
        """Time of the next drawing."""
        return self._next_ns

    @property
    def finished(self) -> bool:
        """True once the viewer is closed."""
        return self._is_closed()

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Draw the last messages."""
        if self._query is not None:
            self._query.end()
        self._draw(now_ns)
        return []

    def _take(self, message: Encoded) -> None:
        self._reader.add(message)
        self._count += 1

    def _is_known(self, message: Encoded) -> bool:
        """True if a message repeats a change of an alarm; any other change is stored."""
        change = _change(message)
        if change is None:
            return False
        if change in self._known:
            return True
        self._known[change] = None
        if len(self._known) > MAX_REMEMBERED:
            del self._known[next(iter(self._known))]
        return False

    def _draw(self, now_ns: int) -> None:
        self._next_ns = now_ns + DRAW_INTERVAL_NS
        if not self._count or (not self._has_zero and now_ns < self._zero_within_ns and self._count < SEGMENT_MESSAGES):
            return
        if not (self._has_zero or self._reader.has_samples) and self._count < SEGMENT_MESSAGES:
            return  # the zero of the run is its first sample
        self._count = 0
        run = self._reader.next_segment()
        if not (self._has_zero or self._reader.has_samples):
            return
        self._drawing.draw(run, PANELS)
        self._zero_within_ns = 0  # minutes of drawn data cannot change
        if self._drawing.layout.changed:
            self._recording.send_blueprint(self._drawing.layout.blueprint(live=True))


def _change(message: Encoded) -> tuple[str, int, str] | None:
    """Key, time and event of a change of an alarm; None for other messages."""
    if message.encoding != _ALARM:
        return None
    try:
        alarm = decode(message.payload, message.encoding)
    except DecodeError:
        return None
    assert isinstance(alarm, Alarm), "the encoding names it"
    return message.key, alarm.time_ns, alarm.event


def stream_to(port: int, address: str, name: str) -> rr.RecordingStream:
    """Stream to a viewer.

    Args:
        port: port of the viewer.
        address: address of the viewer.
        name: id of the recording.
    """
    recording = rr.RecordingStream(APPLICATION, recording_id=name)
    recording.connect_grpc(f"rerun+http://{_in_url(_reachable_address(address))}:{port}/proxy")
    return recording


def _check_screen(platform: str, environment: Mapping[str, str]) -> None:
    """Check for a screen, as the viewer listens before it needs one, and so seems to run without one.

    Raises:
        InputError: no environment variable names a screen.
    """
    if platform == "linux" and not any(environment.get(name) for name in SCREENS):
        raise InputError(f"no window can open: none of {', '.join(SCREENS)} is set; view it with --web in a browser")


def _check_free(address: str, port: int) -> None:
    """Check that a port is free, as any program that listens there would look like the viewer.

    Raises:
        InputError: it is no address of this machine, or the port is in use.
    """
    try:
        version = ip_address(address).version
        with socket.socket(socket.AF_INET6 if version == 6 else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((address, port))
    except ValueError:
        raise InputError(f"--bind must be an IP address of this machine, such as 127.0.0.1, got {address!r}") from None
    except OSError as error:
        cure = "choose another --port" if error.errno == errno.EADDRINUSE else "is it one of this machine?"
        raise InputError(f"nothing can listen at {address} port {port}: {error.strerror}; {cure}") from error


def _reachable_address(address: str) -> str:
    """Address at which this machine reaches a socket that listens on `address`."""
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(address, address)  # noqa: S104 (nothing is bound here)


def _in_url(address: str) -> str:
    return f"[{address}]" if ":" in address else address


def _origins(target: DisplayTarget, page: int) -> tuple[str, ...]:
    """Option for pages of other machines that may read the data; those of this machine always may."""
    return () if target.bind in LOOPBACK else ("--cors-allow-origin", f"http://*:{page}")


def _wait_for(process: subprocess.Popen[bytes], port: int, target: DisplayTarget, log: Path) -> None:
    """Wait until the viewer listens at a port.

    Raises:
        InputError: it has exited, or does not listen in time.
    """
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline:
        try:
            with socket.create_connection((_reachable_address(target.bind), port), timeout=1.0):
                return
        except OSError:
            pass
        try:
            code = process.wait(POLL_S)
        except subprocess.TimeoutExpired:
            continue
        raise _exit_error(code, target, log)
    raise InputError(f"the viewer does not listen at {target.bind}:{port} after {START_TIMEOUT_S:g} s")


def _exit_error(code: int, target: DisplayTarget, log: Path) -> InputError:
    return InputError(describe_exit(code, log) + ("" if target.web else "; it needs a screen, try --web"))


def _stop_with(process: subprocess.Popen[bytes], stop: StopSignal) -> None:
    """Stop once the viewer has exited, also while waiting for a router."""
    process.wait()
    stop.set()
