"""Show a running plant in the Rerun viewer, a child process on loopback by default."""

import contextlib
import errno
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple

import rerun as rr

from reactorwatch.contract import keys
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.http_pages import GuardedPort, free_port
from recorder.view.drawing import APPLICATION
from recorder.view.live import HistoryQuery, LiveDashboard, query_history

NODE = "view"
SCREENS = ("WAYLAND_DISPLAY", "WAYLAND_SOCKET", "DISPLAY")  # those that winit reads
CLEAN_EXIT_CODES = (None, 0, 130, -signal.SIGINT, -signal.SIGTERM)
"""Codes of a viewer that runs, was closed, or was terminated together with this process."""
LOOPBACK = ("127.0.0.1", "::1")


def viewer_program() -> Path:
    """Path of the viewer; the command `rerun` is a script that does not terminate the viewer with itself."""
    package = find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise InputError("no picture: this build of rerun comes without its viewer; install rerun-sdk from PyPI")
    return Path(package.origin).with_name("rerun")


def describe_exit(code: int, log: Path) -> str:
    """Text about a viewer that has exited, with the last line of its output."""
    lines = log.read_text(errors="replace").strip().splitlines()
    return f"the viewer ended with code {code}: {lines[-1] if lines else 'without a message'}"


@contextmanager
def viewer(
    *arguments: str, port: int, bind: str, log: Path, environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a viewer that listens for data within the context, with more arguments and environment variables."""
    command = [str(viewer_program()), "--bind", bind, "--port", str(port), "--hide-welcome-screen", *arguments]
    with log.open("wb") as output:
        process = subprocess.Popen(  # noqa: S603 (the program is Rerun's own, the arguments are paths and numbers)
            command,
            # without the level, log lines of the viewer cover the picture for some seconds
            env={**os.environ, "RUST_LOG": "error", **(environment or {})},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
        )
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


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
    ports = (free_port(), free_port()) if target.port is None else (target.port, target.port + 1)
    for port in ports:
        _check_free(target.bind, port)
    # The viewer serves a page to every host that a request names, so a guard is in front of it.
    page, data = (free_port(), free_port()) if target.web else ports
    # an option for pages of other machines that may read the data; those of this machine always may
    origins = () if target.bind in LOOPBACK else ("--cors-allow-origin", f"http://*:{ports[0]}")
    arguments = ("--serve-web", "--web-viewer-port", str(page), *origins) if target.web else ()
    bind = LOOPBACK[0] if target.web else target.bind
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        stop = stack.enter_context(stop_on_signals())
        log = Path(folder) / "viewer.log"
        with viewer(*arguments, port=data, bind=bind, log=log) as child:
            _wait_for(child, data, bind, target, log)
            if target.web:
                _wait_for(child, page, bind, target, log)  # it is served some time after the data
                for port, served in zip(ports, (page, data), strict=True):
                    stack.enter_context(GuardedPort(target.bind, port, served).serving())
                host = _in_url(_reachable_address(target.bind))
                say(f"open http://{host}:{ports[0]}/?url=rerun%2Bhttp://{host}:{ports[1]}/proxy")
            threading.Thread(target=_stop_with, args=(child, stop), name="viewer", daemon=True).start()
            bus = bus_zenoh.connect(bus_config, NODE, stop)
            if bus is None:
                if child.poll() not in CLEAN_EXIT_CODES:
                    raise _exit_error(child.returncode, target, log)
                return
            try:
                recording = rr.RecordingStream(APPLICATION, recording_id=f"{plant}-{time.time_ns()}")
                recording.connect_grpc(f"rerun+http://{_in_url(_reachable_address(bind))}:{data}/proxy")
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


def _wait_for(process: subprocess.Popen[bytes], port: int, bind: str, target: DisplayTarget, log: Path) -> None:
    """Wait until the viewer listens at a port.

    Raises:
        InputError: it has exited, or does not listen in time.
    """
    deadline = time.monotonic() + 30.0
    while time.monotonic() < deadline:
        try:
            with socket.create_connection((_reachable_address(bind), port), timeout=1.0):
                return
        except OSError:
            pass
        try:
            code = process.wait(0.1)
        except subprocess.TimeoutExpired:
            continue
        raise _exit_error(code, target, log)
    raise InputError(f"the viewer does not listen at {bind}:{port} after 30 s")


def _exit_error(code: int, target: DisplayTarget, log: Path) -> InputError:
    return InputError(describe_exit(code, log) + ("" if target.web else "; it needs a screen, try --web"))


def _stop_with(process: subprocess.Popen[bytes], stop: StopSignal) -> None:
    """Stop once the viewer has exited, also while waiting for a router."""
    process.wait()
    stop.set()
