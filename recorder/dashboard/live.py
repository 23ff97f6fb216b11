"""The dashboard of a plant that runs: what goes over the bus, streamed to a viewer.

The viewer is a process of its own and holds what it is sent; here is nothing that grows with the run. Which views there
are shows in the first seconds of a run, so the layout is sent again whenever one is new.
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
from reactorwatch.errors import InputError
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.loopback import free_port
from recorder.columns.run_reader import STRETCH, RunReader
from recorder.dashboard.drawing import Drawing
from recorder.dashboard.late_joiner import Past, PastQuery, ask_for_past, zero_of
from recorder.dashboard.stream import APPLICATION
from recorder.dashboard.viewer import viewer
from recorder.panels import PANELS

_ALARM = encoding_of(Alarm)

NODE = "view"
SCREENS = ("WAYLAND_DISPLAY", "WAYLAND_SOCKET", "DISPLAY")  # whichever of them winit asks
ENDED_WELL = (None, 0, 130, -signal.SIGINT, -signal.SIGTERM)  # it runs, was closed, or was asked to end as we were
LOOPBACK = ("127.0.0.1", "::1")
DRAW_EVERY_NS = 500_000_000
ZERO_WITHIN_NS = 15_000_000_000
"""Three times the usual period of reports of health."""
START_WITHIN_S = 30.0
LOOK_EVERY_S = 0.1
MOST_KNOWN = 10_000
"""Changes of alarms that are remembered, so that one that is listed is not shown again."""


class Shown(NamedTuple):
    """Where a dashboard is shown: a window, or a page for the browser; `port` is the page's, None: one that is free."""

    web: bool
    bind: str
    port: int | None


def show(plant: str, bus_config: BusConfig, shown: Shown, say: Callable[[str], None]) -> None:
    """Show a plant until the viewer is closed, or SIGINT (Ctrl-C) or SIGTERM comes.

    Args:
        plant: its name.
        bus_config: where the router is.
        shown: where the dashboard is.
        say: told where to look.

    Raises:
        InputError: the viewer does not run on this machine, its address or port cannot be had, or the endpoint makes
            no sense.
    """
    if not shown.web:
        _check_screen(sys.platform, os.environ)
    page, data = (free_port(), free_port()) if shown.port is None else (shown.port, shown.port + 1)
    for port in (page, data):
        _check_free(shown.bind, port)
    arguments = ("--serve-web", "--web-viewer-port", str(page), *_origins(shown, page)) if shown.web else ()
    with tempfile.TemporaryDirectory() as folder, stop_on_signals() as stop:
        log = Path(folder) / "viewer.log"
        with viewer(*arguments, port=data, bind=shown.bind, log=log) as process:
            _wait_for(process, data, shown, log)
            if shown.web:
                _wait_for(process, page, shown, log)  # it is served some time after the data are
                host = _in_url(_reached(shown.bind))
                say(f"open http://{host}:{page}/?url=rerun%2Bhttp://{host}:{data}/proxy")
            threading.Thread(target=_stop_with, args=(process, stop), name="viewer", daemon=True).start()
            bus = bus_zenoh.connect(bus_config, NODE, stop)
            if bus is None:
                if process.poll() not in ENDED_WELL:
                    raise _ended(process.returncode, shown, log)
                return
            try:
                recording = stream_to(data, shown.bind, f"{plant}-{time.time_ns()}")
                past = ask_for_past(bus, plant)
                query = PastQuery(lambda: ask_for_past(bus, plant), past.answered)
                dashboard = LiveDashboard(recording, lambda: process.poll() is not None, time.time_ns(), past, query)
                loop = EventLoop(dashboard, bus, stop)
                loop.subscribe(f"{keys.ROOT}/{plant}/**", history_s=bus_config.history_s)
                loop.subscribe_liveliness(keys.all_keys(plant, keys.ALIVE), on_token=dashboard.on_alive)
                loop.run()
                recording.disconnect()
            finally:
                bus.close()


class LiveDashboard:
    """Draws what it hears; see `reactorwatch.runtime.event_loop.Node`.

    Args:
        recording: the stream, connected to a viewer.
        is_closed: whether the viewer is.
        now_ns: the clock.
        past: what was before it began to listen.
        query: asks for alarms again when a node appears; None: nothing is asked again.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        is_closed: Callable[[], bool],
        now_ns: int,
        past: Past = Past(),  # noqa: B008 (it is frozen)
        query: PastQuery | None = None,
    ) -> None:
        self._recording = recording
        self._is_closed = is_closed
        self._drawing = Drawing(recording)
        self._reader = RunReader(past.zero_ns)
        self._has_zero = past.zero_ns is not None
        # a fleet's monitor remembers no report of health: the next one says the zero
        self._zero_within_ns = now_ns + (ZERO_WITHIN_NS if not self._has_zero and "monitor" in past.answered else 0)
        self._query = query
        self._known = dict.fromkeys(map(_change, past.alarms))
        self._taken = len(past.alarms)
        for message in past.alarms:
            self._reader.take(message)
        self._next_ns = now_ns + DRAW_EVERY_NS

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Keep it until there is something to be drawn."""
        if self._is_known(message):
            return []  # publishers remember it, and it was listed
        if now_ns < self._zero_within_ns and not self._has_zero and (zero_ns := zero_of(message)) is not None:
            self._reader.count_from(zero_ns)
            self._has_zero = True
        self._take(message)
        if self._taken >= STRETCH or now_ns >= self._next_ns:
            self._draw(now_ns)
        return []

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Nobody asks a dashboard."""
        raise AssertionError(question.key)

    def on_alive(self, token: str, is_alive: bool, _now_ns: int) -> list[Publication]:
        """Ask a node that appears for its alarms."""
        if self._query is not None:
            self._query.on_alive(token, is_alive)
        return []

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Draw what has come."""
        for past in self._query.answers() if self._query is not None else ():
            for message in past.alarms:
                if not self._is_known(message):
                    self._take(message)
        self._draw(now_ns)
        return []

    def next_tick_ns(self) -> int:
        """Every half second."""
        return self._next_ns

    @property
    def finished(self) -> bool:
        """Whether the viewer has been closed."""
        return self._is_closed()

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Draw the last."""
        if self._query is not None:
            self._query.end()
        self._draw(now_ns)
        return []

    def _take(self, message: Encoded) -> None:
        self._reader.take(message)
        self._taken += 1

    def _is_known(self, message: Encoded) -> bool:
        """True if it is a change of an alarm that was taken before; it counts as one from now on."""
        change = _change(message)
        if change is None:
            return False
        if change in self._known:
            return True
        self._known[change] = None
        if len(self._known) > MOST_KNOWN:
            del self._known[next(iter(self._known))]
        return False

    def _draw(self, now_ns: int) -> None:
        self._next_ns = now_ns + DRAW_EVERY_NS
        if not self._taken or (not self._has_zero and now_ns < self._zero_within_ns and self._taken < STRETCH):
            return
        if not (self._has_zero or self._reader.has_samples) and self._taken < STRETCH:
            return  # the time of the run begins with its first sample
        self._taken = 0
        run = self._reader.cut()
        if not (self._has_zero or self._reader.has_samples):
            return
        self._drawing.draw(run, PANELS)
        self._zero_within_ns = 0  # the minutes of what is drawn stay
        if self._drawing.layout.changed:
            self._recording.send_blueprint(self._drawing.layout.blueprint(live=True))


def _change(message: Encoded) -> tuple[str, int, str] | None:
    """The key, the time and the event of a change of an alarm; None if it is none."""
    if message.encoding != _ALARM:
        return None
    try:
        alarm = decode(message.payload, message.encoding)
    except DecodeError:
        return None
    assert isinstance(alarm, Alarm), "the encoding says so"
    return message.key, alarm.time_ns, alarm.event


def stream_to(port: int, address: str, name: str) -> rr.RecordingStream:
    """A stream to a viewer.

    Args:
        port: that it listens at.
        address: that it listens on.
        name: of the recording.
    """
    recording = rr.RecordingStream(APPLICATION, recording_id=name)
    recording.connect_grpc(f"rerun+http://{_in_url(_reached(address))}:{port}/proxy")
    return recording


def _check_screen(platform: str, environment: Mapping[str, str]) -> None:
    """The viewer listens before it looks for a screen, so it seems to run for a moment where there is none.

    Raises:
        InputError: no screen is named to programs here.
    """
    if platform == "linux" and not any(environment.get(name) for name in SCREENS):
        raise InputError(f"no window can open: none of {', '.join(SCREENS)} is set; view it with --web in a browser")


def _check_free(address: str, port: int) -> None:
    """What somebody else listens at would look like the viewer.

    Raises:
        InputError: it is no address of this machine, or the port is taken.
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


def _reached(address: str) -> str:
    """How this machine reaches what listens on an address."""
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(address, address)  # noqa: S104 (nothing is bound here)


def _in_url(address: str) -> str:
    return f"[{address}]" if ":" in address else address


def _origins(shown: Shown, page: int) -> tuple[str, ...]:
    """Pages that may ask for the data, beside those of this machine, which may anyway."""
    return () if shown.bind in LOOPBACK else ("--cors-allow-origin", f"http://*:{page}")


def _wait_for(process: subprocess.Popen[bytes], port: int, shown: Shown, log: Path) -> None:
    """Wait until the viewer listens at a port.

    Raises:
        InputError: it has ended, or does not within the time.
    """
    deadline = time.monotonic() + START_WITHIN_S
    while time.monotonic() < deadline:
        try:
            with socket.create_connection((_reached(shown.bind), port), timeout=1.0):
                return
        except OSError:
            pass
        try:
            code = process.wait(LOOK_EVERY_S)
        except subprocess.TimeoutExpired:
            continue
        raise _ended(code, shown, log)
    raise InputError(f"the viewer does not listen at {shown.bind}:{port} after {START_WITHIN_S:g} s")


def _ended(code: int, shown: Shown, log: Path) -> InputError:
    said = log.read_text(errors="replace").strip().splitlines()
    cure = "" if shown.web else "; it needs a screen, try --web"
    return InputError(f"the viewer ended with code {code}: {said[-1] if said else 'it did not say why'}{cure}")


def _stop_with(process: subprocess.Popen[bytes], stop: StopSignal) -> None:
    """Nobody is shown anything once the viewer has ended, also while there is no router yet."""
    process.wait()
    stop.set()
