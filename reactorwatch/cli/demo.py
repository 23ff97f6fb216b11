"""`demo`: run all nodes once, in accelerated plant time with a fault, and summarise the result.

These are real processes on a real router on loopback. The summary is made from the recording: the onset of the fault,
the alarms, a comparison with the alarms of a back-test, value for value, and a diagnosis.
"""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from reactorwatch.api.files import open_messages
from reactorwatch.cli.display import bar, format_age, print_lines, print_report, task
from reactorwatch.cli.kernels import compile_at_first_start
from reactorwatch.cli.plant_settings import WAIT_FOR, complete_plant_settings
from reactorwatch.cli.processes import (
    POLL_S,
    Processes,
    RunProgress,
    load_bus_settings,
    open_router,
    restrict_to_plant,
    write_node_settings,
)
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Alarm, Fault, Incident, Sample
from reactorwatch.description.process import Process
from reactorwatch.description.read import find_process
from reactorwatch.diagnosis.result import NAMED, Diagnosis
from reactorwatch.errors import InputError
from reactorwatch.process import DEFAULT_PROCESS
from reactorwatch.process.effect import Effect
from reactorwatch.process.fault import FaultSpecification, parse_fault
from reactorwatch.records.record import MINUTE_NS, to_minutes, to_time_ns
from reactorwatch.records.write import atomic_write, make_folder
from reactorwatch.runtime.bus_zenoh import ZenohBus
from reactorwatch.runtime.config import section
from reactorwatch.runtime.event_loop import StopSignal, stop_on_signals
from reactorwatch.runtime.http_pages import free_endpoint
from reactorwatch.runtime.node_main import INTERRUPTED, configure_log
from reactorwatch.sentences.alarm import suspects_text
from reactorwatch.terminal import printable_lines
from recorder.config import RecorderConfig
from recorder.core import DISK_ALARM

PLANT = "demo"
NODES = ("recorder", "monitor", "plant")
"""Nodes in the order of their start."""

ONSET_MIN = 150.0
"""Onset of the fault: the training ends after 100 minutes."""

START_WITHIN_S = 60.0
SETTINGS_FILE = "settings.toml"
DIAGNOSIS_FOLDER = "diagnosis"


def choose_fault(text: str | None, process: Process) -> FaultSpecification:
    """Fault to inject."""
    if text is None and process.operation.fault:
        text = f"{process.operation.fault}@{ONSET_MIN:g}min"
    elif text is None:
        process.require_model()
        effect = process.faults[0]
        text = f"{effect.name}:step:{effect.typical!r}@{ONSET_MIN:g}min"
    return parse_fault(text, process.faults)


def run(flags: dict[str, Any], fault: str | None, out: Path | None, site: Path | None = None) -> int:
    """Run the demonstration."""
    configure_log()
    process = find_process(flags["process"] or DEFAULT_PROCESS)
    injected = str(choose_fault(fault, process))
    join = load_bus_settings(site, PLANT, {}, free_endpoint() if site is None else None)
    folder = _free_folder(out)
    recording = folder / f"{PLANT}.mcap"
    of_plant = {**flags, "name": PLANT, "faults": (injected,), "wait_for": WAIT_FOR}
    plant = complete_plant_settings(section(PlantConfig, "plant", {}, of_plant))
    monitor = section(MonitorConfig, "monitor", {}, {"plant": PLANT, "process": flags["process"]})
    recorder = RecorderConfig(
        plant=PLANT,
        out=str(recording),
        linger_s=1.0,  # it is stopped last
        black_box_min=0.0,
        processes={PLANT: flags["process"] or DEFAULT_PROCESS},
        about={"seed": str(plant.seed)},
    )
    compile_at_first_start()
    with open_router(site, join) as bus:
        make_folder(folder, "--out")
        tables = {"plant": plant, "monitor": monitor}
        settings = write_node_settings(folder / SETTINGS_FILE, restrict_to_plant(recorder, site), tables, join, NODES)
        print_lines(f"to see it as it runs: reactorwatch view --web --config {folder / SETTINGS_FILE}", err=True)
        with stop_on_signals(is_supervisor=True) as stop:
            if not _run_nodes(bus, stop, settings, folder, plant, process.name):
                print_lines(f"stopped; what was recorded until then is in {folder}", err=True)
                return INTERRUPTED if stop.interrupted else 0
    return _conclude(folder, recording, monitor, injected)


def _free_folder(out: Path | None) -> Path:
    folder = out or Path("runs") / time.strftime("demo-%Y%m%d-%H%M%S")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"--out {folder}: is there already and not empty; choose another, or remove it")
    return folder


def _run_nodes(
    bus: ZenohBus, stop: StopSignal, settings: dict[str, Path], folder: Path, plant: PlantConfig, process: str
) -> bool:
    """Run the nodes until the plant has finished; returns False if a signal stopped it before."""
    assert plant.rows is not None, "a demonstration has an end"
    duration_min = plant.rows * plant.period_min
    progress = RunProgress(bus, PLANT, to_time_ns((plant.rows - 1) * plant.period_min))
    unwritten: SimpleQueue[str] = SimpleQueue()

    def on_disk_alarm(message: Encoded) -> None:
        alarm = decode(message.payload, message.encoding)
        if isinstance(alarm, Alarm) and alarm.event == "raised":
            unwritten.put(alarm.text)

    bus.subscribe(keys.key(PLANT, keys.ALARM, DISK_ALARM), on_disk_alarm)
    with Processes(settings, logs=folder) as processes, bar("starting the nodes", duration_min) as advance:
        for node in NODES:
            processes.start(node)
        started = time.monotonic()
        while not stop.wait(POLL_S):
            if not unwritten.empty():
                break
            ended = processes.exit_codes()
            failed = {node: code for node, code in ended.items() if code or node != "plant"}
            if failed:
                node, code = next(iter(failed.items()))
                raise InputError(_describe_end(node, code, folder))
            if "plant" in ended:
                break
            if not progress.started and time.monotonic() - started > START_WITHIN_S:
                raise InputError(f"no sample within {START_WITHIN_S:g} s of the start; see the .log files in {folder}")
            advance(progress.plant_min, "starting the nodes" if not progress.started else f"running {process}")
        progress.wait_until_evaluated(lambda seconds: stop.wait(seconds) or not unwritten.empty())
        ended = processes.stop(("plant", "monitor", "recorder"))
    if not unwritten.empty():
        raise InputError(f"{folder} is not complete: {unwritten.get()}; make room, and run it again")
    for node, code in ended.items():
        if code and not stop.is_set:
            raise InputError(_describe_end(node, code, folder))
    return not stop.is_set


def _describe_end(node: str, code: int, folder: Path) -> str:
    """Describe the end of a node that failed, by the last line of its log."""
    path = folder / f"{node}.log"
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    last = next((line for line in reversed(lines) if line.strip()), "it says nothing")
    return f"the {node} ended with code {code}; the last line of {path}: {last.removeprefix(node + ': ')}"


def _conclude(folder: Path, recording: Path, monitor: MonitorConfig, fault: str) -> int:
    """Diagnose and draw the recording, and write the summary; returns the exit code."""
    from reactorwatch.api.diagnosis import diagnose_case
    from reactorwatch.cli.diagnose import DRAWING, MODEL, PAGE, DiagnosisOptions, load_case, write_report
    from reactorwatch.sentences.diagnosis import describe_verdict
    from recorder.columns import read_segments
    from recorder.view.file import write_rrd

    drawing = recording.with_suffix(".rrd")
    with task("checking"):
        first_ns, faults, alarms, incidents = _events(recording)
        again = backtest.run(open_messages(recording, PLANT).messages, monitor)
    with task("diagnosing"):
        asked = DiagnosisOptions(plant=PLANT)
        diagnosis = diagnose_case(load_case(recording, asked), asked.tolerance, asked.limits)
        write_report(diagnosis, recording, folder / DIAGNOSIS_FOLDER, asked)
    with task("drawing"):
        source = open_messages(recording, PLANT)
        run_columns = read_segments(source.messages, process=source.process)
        write_rrd(run_columns, drawing, diagnosis=folder / DIAGNOSIS_FOLDER / DRAWING)
    same = [alarm.SerializeToString() for alarm in alarms] == [
        alarm.SerializeToString() for alarm in again.alarm_messages
    ]
    raised = [alarm for alarm in alarms if alarm.event == "raised"]
    suspected = [incident for incident in incidents if incident.suspects]
    onset_ns = min((item.onset_ns for item in faults if item.active), default=None)
    before = [alarm for alarm in raised if onset_ns is None or alarm.time_ns < onset_ns]
    after = [alarm for alarm in raised if onset_ns is not None and alarm.time_ns >= onset_ns]

    def minutes(time_ns: int) -> str:
        return f"{to_minutes(time_ns, first_ns):.1f} min"

    delay_s = None if onset_ns is None or not after else (after[0].time_ns - onset_ns) / 1e9
    lines = [
        "# What happened",
        "",
        headline(delay_s, diagnosis.result, diagnosis.effects),
        "",
        f"- Fault injected: `{fault}`, onset at {minutes(onset_ns)}."
        if onset_ns is not None
        else f"- Fault `{fault}` did not start: the run was too short.",
    ]
    for alarm in after:
        late = (alarm.time_ns - (onset_ns or 0)) / MINUTE_NS
        lines.append(
            f"- Alarm raised: `{alarm.alarm}` at {minutes(alarm.time_ns)}, {late:.1f} min after the fault: "
            f"{alarm.text}."
        )
    if not after:
        lines.append("- No alarm was raised after the fault.")
    if suspected:
        last = suspected[-1]
        named = next(item for item in suspected if item.number == last.number and item.suspects == last.suspects)
        late = (named.time_ns - (onset_ns or 0)) / MINUTE_NS
        lines.append(f"- Likely cause, {late:.1f} min after the fault: {suspects_text(last.suspects, first_ns)}.")
    lines.append(
        "- False alarms before the fault: "
        + (", ".join(f"`{alarm.alarm}` at {minutes(alarm.time_ns)}" for alarm in before) or "none")
        + f" ({again.expected_false_alarms:.2g} expected in the whole run)."
    )
    lines.append(f"- Diagnosis of the whole recording: {describe_verdict(diagnosis.result)}")
    lines.append(f"- Back-test over the recording: {'the same alarms, value for value' if same else 'OTHER ALARMS'}.")
    lines += [
        "",
        "# Which file to open",
        "",
        f"- `{drawing.name}`: the run as a dashboard. `{_program('rerun')} {drawing}`",
        f"- `{DIAGNOSIS_FOLDER}/{PAGE}`: the report of the diagnosis, for a browser;"
        f" `{DIAGNOSIS_FOLDER}/{MODEL}` has the equations with the cause in them.",
        f"- `{recording.name}`: all messages; it also opens in Foxglove and PlotJuggler.",
        f"- `{SETTINGS_FILE}`: all settings, seeds included; the `.log` files: logs of the nodes.",
        "",
    ]
    text = printable_lines(lines)
    print_report(text)
    with atomic_write(folder / "summary.md") as temporary:
        temporary.write_text(text, encoding="utf-8")
    print_lines(f"All of it is in {folder}")
    return 0 if after and not before and same else 1


def headline(delay_s: float | None, diagnosis: Diagnosis, effects: Sequence[Effect]) -> str:
    """Delay of the detection, and the cause that the diagnosis names, in a sentence."""
    detected = "Not detected" if delay_s is None else f"Detected after {format_age(delay_s)}"
    catalogue = {effect.name: effect for effect in effects}
    causes = [
        f"{cause.label}, {catalogue[cause.cause].describe(cause.parameters['size'].value)}"
        for cause in diagnosis.causes
        if cause.cause in catalogue
    ]
    if diagnosis.verdict == NAMED and causes:
        return f"{detected}; cause named: {' and '.join(causes)}."
    return f"{detected}; no single cause named: the diagnosis is {diagnosis.verdict}."


def _program(name: str) -> str:
    """Path of a program of this installation, relative to the working folder if it is below."""
    path = Path(sys.executable).with_name(name)
    folder = Path.cwd()
    return str(path.relative_to(folder) if path.is_relative_to(folder) else path)


def _events(recording: Path) -> tuple[int, list[Fault], list[Alarm], list[Incident]]:
    first_ns: int | None = None
    faults: list[Fault] = []
    alarms, incidents = list[Alarm](), list[Incident]()
    for message in open_messages(recording, PLANT).messages:
        body = decode(message.payload, message.encoding)
        if isinstance(body, Sample):
            first_ns = body.time_ns if first_ns is None else min(first_ns, body.time_ns)
        elif isinstance(body, Fault):
            faults.append(body)
        elif isinstance(body, Alarm):
            alarms.append(body)
        elif isinstance(body, Incident):
            incidents.append(body)
    if first_ns is None:
        raise InputError(f"{recording}: holds no sample")
    return first_ns, faults, alarms, incidents
