"""Diagnoses beside a live monitor: after an alarm the recent samples are written down and diagnosed.

It hears the same bus as the monitor, is a process of its own, and leaves the work to another one: whatever a diagnosis
takes or breaks, plant and monitor do not notice. Each gets a folder, named after the plant and the time of the alarm,
with the samples as a recording and the report of `reactorwatch diagnose` on it, so that it can be done again by hand.
"""

import subprocess
import sys
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import structlog

from diagnosis_node.trigger import AfterAlarm, Asked, DiagnosisConfig
from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.folder import make_folder
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import EventLoop, stop_on_signals
from recorder.message import RecordedMessage
from recorder.storage.mcap_writer import RecordingWriter

log = structlog.get_logger()

NODE = "diagnosis"
RECORDING = "record.mcap"
"""Name of what is diagnosed, in the folder of its report."""

DRAIN_TIMEOUT_S = 0.5

Run = Callable[[list[str]], tuple[int, str, str]]
"""Runs arguments of `reactorwatch`; returns its exit code, what it said, and what it complained of."""


class Diagnoses:
    """Writes samples down and has them diagnosed, one at a time.

    Args:
        config: settings, with a folder to write to.
        run: runs the command.
        in_background: calls something without waiting for its end.
    """

    def __init__(self, config: DiagnosisConfig, run: Run, in_background: Callable[[Callable[[], None]], None]) -> None:
        if config.out is None:
            raise ValueError("out must be a folder")
        self._config, self._out, self._run, self._in_background = config, Path(config.out), run, in_background
        self.busy = False

    def begin(self, asked: Asked) -> None:
        """Begin one; see `AfterAlarm`."""
        self.busy = True
        self._in_background(lambda: self._diagnose(asked))

    def _diagnose(self, asked: Asked) -> None:
        try:
            folder = self._written(asked)
            code, said, complained = self._run([*self._command(folder), "--json"])
            if code != 0:
                log.warning("not diagnosed", alarm=asked.alarm, why=_last_line(complained), folder=str(folder))
                return
            found = msgspec.json.decode(said)
            log.info("diagnosed", alarm=asked.alarm, **_summary(found), report=str(folder / "report.html"))
        except (InputError, OSError, msgspec.DecodeError) as error:
            log.warning("not diagnosed", alarm=asked.alarm, why=str(error))
        finally:
            self.busy = False

    def _written(self, asked: Asked) -> Path:
        """The folder with the samples in it."""
        folder = make_folder(self._free_folder(asked.raised_ns), may_exist=False)
        about = {"plant": self._config.plant, "alarm": asked.alarm, "raised_ns": str(asked.raised_ns)}
        with atomic_write(folder / RECORDING) as temporary, RecordingWriter(temporary, about) as writer:
            for time_ns, item in asked.samples:
                writer.write(
                    RecordedMessage(item.key, item.payload, item.encoding, item.received_ns or time_ns, time_ns)
                )
        return folder

    def _free_folder(self, raised_ns: int) -> Path:
        moment = datetime.fromtimestamp(raised_ns // 10**9, UTC)
        name = f"{self._config.plant}-{moment:%Y%m%dT%H%M%SZ}"
        taken = sum(path.name == name or path.name.startswith(f"{name}-") for path in self._out.glob(f"{name}*"))
        return self._out / (f"{name}-{taken + 1}" if taken else name)

    def _command(self, folder: Path) -> list[str]:
        command = ["diagnose", str(folder / RECORDING), "--plant", self._config.plant, "--out", str(folder)]
        if self._config.model is not None:
            command += ["--model", self._config.model]
        if self._config.tolerance:
            command += ["--tolerance", ",".join(f"{name}={value!r}" for name, value in self._config.tolerance.items())]
        return command


class Command:
    """`reactorwatch` as a process of its own, which can be ended."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._ended = False

    def __call__(self, arguments: list[str]) -> tuple[int, str, str]:
        """See `Run`."""
        command = [sys.executable, "-m", "reactorwatch", *arguments]
        self._process = subprocess.Popen(  # noqa: S603 (our own command)
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        if self._ended:
            self._process.terminate()
        said, complained = self._process.communicate()
        return self._process.returncode, said, complained or "it was stopped"

    def end(self) -> None:
        """End the process that runs, if there is one, and every later one."""
        self._ended = True
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()


def run(config: DiagnosisConfig, bus_config: BusConfig) -> None:
    """Diagnose after alarms until SIGINT or SIGTERM.

    Raises:
        InputError: settings that the bus cannot use, or no folder to write to.
    """
    if config.out is None:
        raise InputError("settings [diagnosis]: out must be a folder for the reports")
    command, threads = Command(), list[threading.Thread]()

    def in_background(work: Callable[[], None]) -> None:
        threads[:] = [threading.Thread(target=work, name="diagnosis")]
        threads[0].start()

    diagnoses = Diagnoses(config, command, in_background)
    node = AfterAlarm(config, diagnoses.begin, lambda: diagnoses.busy)
    with stop_on_signals() as stop:
        bus = bus_zenoh.connect(bus_config, NODE, stop)
        if bus is None:
            return
        try:
            log.info("diagnosing after alarms", plant=config.plant, after_min=config.after_min, out=config.out)
            loop = EventLoop(node, bus, stop, drain_timeout_s=DRAIN_TIMEOUT_S)
            loop.subscribe(*(keys.all_keys(config.plant, kind) for kind in (keys.SAMPLE, keys.ALARM)))
            bus.declare_token(keys.key(config.plant, keys.ALIVE, NODE))
            loop.run()
        finally:
            bus.close()
            command.end()
            for thread in threads:
                thread.join()
            if node.waiting is not None:
                log.warning("not diagnosed", alarm=node.waiting, why="stopped before there was enough to see")


def _summary(found: dict[str, Any]) -> dict[str, str]:
    """Of the object that `diagnose --json` prints, what fits a line."""
    said = {"verdict": found["verdict"]}
    causes = [
        f"{item['label']} ({item['cause']}, {item['profile']}) {item['parameters']['size']['value']:.3g}"
        for item in found["causes"]
    ]
    if causes:
        said["causes"] = " with ".join(causes)
    if found["alternatives"]:
        said["alternatives"] = str(len(found["alternatives"]))
    if found["verdict"] == "unknown" and found["location"]:
        said["location"] = found["location"]
    return said


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no reason was given"])[-1]
