"""The diagnosis node, `python -m diagnosis_node [settings.toml]`: diagnoses a plant's record after an alarm.

The node subscribes to the same bus as the monitor and runs each diagnosis in a process of its own, so that neither its
load nor its failure affects plant and monitor. Each diagnosis gets a folder, named after the plant and the time of the
alarm, with the samples as a recording and the report of `reactorwatch diagnose`, so that it can be repeated by hand.
"""

import subprocess
import sys
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import structlog

from diagnosis_node.trigger import DiagnosisConfig, DiagnosisTrigger
from reactorwatch.contract import keys
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.errors import InputError
from reactorwatch.records.write import make_folder
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import EventLoop, stop_on_signals
from reactorwatch.runtime.node_main import main
from reactorwatch.runtime.start import instance_name, join
from recorder import RecordedMessage
from recorder.files.writer import RecordingWriter

log = structlog.get_logger()

NODE = "diagnosis"
RECORDING = "record.mcap"  # the diagnosed recording, in the folder of its report


class DiagnosisRunner:
    """Records samples and diagnoses them in a thread and a process, one diagnosis at a time."""

    def __init__(self, config: DiagnosisConfig) -> None:
        self._config, self._out = config, Path(config.out or "")
        self._thread: threading.Thread | None = None
        self._process: subprocess.Popen[str] | None = None
        self._ended = False

    @property
    def busy(self) -> bool:
        """True while a diagnosis runs."""
        return self._thread is not None and self._thread.is_alive()

    def start(self, alarm: Alarm, samples: list[RecordedMessage]) -> None:
        """Start a diagnosis; see `DiagnosisTrigger`."""
        self._thread = threading.Thread(target=self._diagnose, args=(alarm, samples), name="diagnosis")
        self._thread.start()

    def wait(self) -> None:
        """Wait for the end of a running diagnosis."""
        if self._thread is not None:
            self._thread.join()

    def end(self) -> None:
        """Terminate a running diagnosis, and every later one."""
        self._ended = True
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
        self.wait()

    def execute(self, arguments: list[str]) -> tuple[int, str, str]:
        """Run `reactorwatch` with arguments; returns exit code, standard output and standard error."""
        command = [sys.executable, "-P", "-m", "reactorwatch", *arguments]
        self._process = subprocess.Popen(  # noqa: S603 (our own command)
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        if self._ended:
            self._process.terminate()
        output, errors = self._process.communicate()
        return self._process.returncode, output, errors or "it was stopped"

    def _diagnose(self, alarm: Alarm, samples: list[RecordedMessage]) -> None:
        try:
            folder = self._write_record(alarm, samples)
            command = ["diagnose", str(folder / RECORDING), "--plant", self._config.plant, "--out", str(folder)]
            if self._config.process is not None:
                command += ["--process", self._config.process]
            if self._config.tolerance:
                tolerances = (f"{name}={value!r}" for name, value in self._config.tolerance.items())
                command += ["--tolerance", ",".join(tolerances)]
            code, output, errors = self.execute([*command, "--json"])
            if code != 0:
                why = (errors.strip().splitlines() or ["no reason was given"])[-1]
                log.warning("not diagnosed", alarm=alarm.alarm, why=why, folder=str(folder))
                return
            result = msgspec.json.decode(output)
            log.info("diagnosed", alarm=alarm.alarm, **_summary(result), report=str(folder / "report.html"))
        except (InputError, OSError, msgspec.DecodeError) as error:
            log.warning("not diagnosed", alarm=alarm.alarm, why=str(error))

    def _write_record(self, alarm: Alarm, samples: list[RecordedMessage]) -> Path:
        """Write the samples to a new folder, which is returned."""
        name = f"{self._config.plant}-{datetime.fromtimestamp(alarm.raised_ns // 10**9, UTC):%Y%m%dT%H%M%SZ}"
        taken = sum(path.name == name or path.name.startswith(f"{name}-") for path in self._out.glob(f"{name}*"))
        folder = make_folder(self._out / (f"{name}-{taken + 1}" if taken else name), may_exist=False)
        metadata = {"plant": self._config.plant, "alarm": alarm.alarm, "raised_ns": str(alarm.raised_ns)}
        with RecordingWriter(folder / RECORDING, metadata) as writer:
            for sample in samples:
                writer.write(sample)
        return folder


def run(config: DiagnosisConfig, bus_config: BusConfig, _metrics_config: MetricsConfig) -> None:
    """Diagnose after alarms until SIGINT or SIGTERM."""
    if config.out is None:
        raise InputError("settings [diagnosis]: out must be a folder for the reports")
    diagnoses = DiagnosisRunner(config)
    node = DiagnosisTrigger(config, diagnoses.start, lambda: diagnoses.busy)
    token = keys.instance_token(config.plant, NODE, instance_name())
    with stop_on_signals() as stop, join(bus_config, NODE, stop, token) as bus:
        if bus is None:
            return
        try:
            log.info("diagnosing after alarms", plant=config.plant, after_min=config.after_min, out=config.out)
            loop = EventLoop(node, bus, stop, drain_timeout_s=0.5)
            loop.subscribe(*(keys.all_keys(config.plant, kind) for kind in (keys.SAMPLE, keys.ALARM)))
            bus.declare_token(keys.key(config.plant, keys.ALIVE, NODE))
            loop.run()
        finally:
            diagnoses.end()
            if node.waiting is not None:
                log.warning("not diagnosed", alarm=node.waiting.alarm, why="stopped before enough data came")


def _summary(result: dict[str, Any]) -> dict[str, Any]:
    """Log fields for the object that `diagnose --json` prints, without empty ones."""
    causes = [
        f"{item['label']} ({item['cause']}, {item['profile']}) {item['parameters']['size']['value']:.3g}"
        for item in result["causes"]
    ]
    location = result["location"] if result["verdict"] == "unknown" else None
    fields = {"causes": " with ".join(causes), "alternatives": len(result["alternatives"]), "location": location}
    return {"verdict": result["verdict"]} | {name: value for name, value in fields.items() if value}


if __name__ == "__main__":
    sys.exit(main("diagnosis_node", "diagnosis", DiagnosisConfig, run))
