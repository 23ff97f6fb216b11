"""`up`: run the router in this process and the nodes as processes, until stopped."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import structlog

from diagnosis_node.trigger import DiagnosisConfig
from monitor_node.config import MonitorConfig
from monitor_node.watch.evaluation import check_promise
from plant_node.config import PlantConfig
from reactorwatch.cli.kernels import compile_at_first_start
from reactorwatch.cli.option_groups import BusOptions
from reactorwatch.cli.plant_settings import PlayedRecord, load_source
from reactorwatch.cli.processes import (
    POLL_S,
    VIEWER,
    BusSettings,
    Processes,
    RunProgress,
    load_bus_settings,
    open_router,
    restrict_to_plant,
    write_node_settings,
    write_settings,
)
from reactorwatch.description.read import find_process
from reactorwatch.diagnosis.practical_significance import check_tolerance
from reactorwatch.errors import InputError
from reactorwatch.limits import limits
from reactorwatch.process import DEFAULT_PROCESS
from reactorwatch.records.write import check_folder_name, make_folder
from reactorwatch.runtime.config import BusConfig, LogConfig, MetricsConfig, read_settings, section
from reactorwatch.runtime.event_loop import stop_on_signals
from reactorwatch.runtime.node_main import configure_log
from recorder.config import RecorderConfig
from recorder.keep import ENDING
from recorder.recording_files import file_names

log = structlog.get_logger()


def run_until_stopped(
    target: BusOptions,
    out: Path | None,
    flags: dict[str, Any],
    diagnose: Path | None = None,
    site: Path | None = None,
    played: PlayedRecord | None = None,
) -> int:
    """Run everything until SIGINT, SIGTERM or SIGHUP, or until a node ends by itself."""
    tables = read_settings(target.config)
    log_config = section(LogConfig, "log", tables, {})
    configure_log(as_json=log_config.format == "json")
    source = load_source(tables, flags, played)
    monitor = section(MonitorConfig, "monitor", tables, source.monitor_flags(tables))
    if isinstance(source.settings, PlantConfig):
        try:
            check_promise(monitor, source.settings.period_min)
        except InputError as error:
            raise InputError(f"settings [monitor]: {error}") from error
    of_recorder = tables.get("recorder", {})
    processes = {source.plant: source.process, **of_recorder.get("processes", {})}
    of_recorder = {"recorder": {"out": "runs", **of_recorder, "processes": processes}}
    recorder_flags = {"plant": source.plant, "out": str(out) if out is not None else None}
    recorder = restrict_to_plant(section(RecorderConfig, "recorder", of_recorder, recorder_flags), site)
    join = load_bus_settings(site, source.plant, tables, target.endpoint)
    diagnosis = diagnosis_settings(tables, monitor, diagnose)
    metrics = section(MetricsConfig, "metrics", tables, {})
    if Path(recorder.out).suffix != ENDING:
        check_folder_name(Path(recorder.out), "--out")
    compile_at_first_start()
    with open_router(site, join) as bus:  # before anything is written, in case the address is taken
        tables_written = {source.node: source.settings, "monitor": monitor, "diagnosis": diagnosis, "metrics": metrics}
        nodes = ("recorder", *(["diagnosis"] if diagnosis.out else []), "monitor", source.node)
        settings = _write_settings(
            recorder, source.about, {**tables_written, "log": log_config, "limits": limits()}, join, nodes
        )
        with stop_on_signals(is_supervisor=True) as stop, Processes(settings) as processes_running:
            progress = RunProgress(bus, source.plant) if source.has_end else None
            for node in nodes:
                processes_running.start(node)
            log.info("running", plant=source.plant, router=join[VIEWER].endpoint, out=recorder.out, stop="Ctrl-C")
            while not stop.wait(POLL_S):
                ended = processes_running.exit_codes()
                if ended:
                    for node, code in ended.items():
                        log.info("ended by itself", node=node, code=code)
                    if progress is not None and ended == {source.node: 0}:
                        progress.wait_until_evaluated(stop.wait)
                    return 1 if any(ended.values()) else 0
            return 0


def diagnosis_settings(tables: dict[str, dict[str, Any]], monitor: MonitorConfig, out: Path | None) -> DiagnosisConfig:
    """Settings of diagnoses after alarms."""
    of_monitor = {"plant": monitor.plant, **({"process": monitor.process} if monitor.process else {})}
    stated = tables.get("diagnosis", {})
    if "model" in stated:  # the older name
        of_monitor.pop("process", None)
    tables = {"diagnosis": {**of_monitor, **stated}}
    settings = section(DiagnosisConfig, "diagnosis", tables, {"out": str(out) if out is not None else None})
    if settings.out is not None:
        if Path(settings.out).exists() and not Path(settings.out).is_dir():
            raise InputError(f"--diagnose {settings.out}: is a file, the name of a folder was expected")
        model = find_process(settings.process or DEFAULT_PROCESS).require_model()
        try:  # now, and not after an alarm
            check_tolerance(model, settings.tolerance)
        except InputError as error:
            raise InputError(f"settings [diagnosis]: {error}") from error
    return settings


@contextlib.contextmanager
def run_diagnosis_node(config: DiagnosisConfig, bus_config: BusConfig, log_config: LogConfig) -> Iterator[None]:
    """Run the diagnosis node in a process of its own while the context lasts."""
    with TemporaryDirectory() as folder:
        settings = Path(folder) / "settings.toml"
        write_settings(settings, {"bus": bus_config, "diagnosis": config, "log": log_config, "limits": limits()})
        with Processes({"diagnosis": settings}) as processes:
            processes.start("diagnosis")
            yield


def _write_settings(
    recorder: RecorderConfig,
    about: dict[str, str],
    others: dict[str, msgspec.Struct],
    join: BusSettings,
    nodes: Sequence[str],
) -> dict[str, Path]:
    """Write the settings beside the recordings, under the same name; returns each node's file."""
    out = Path(recorder.out)
    make_folder(out.parent if out.suffix == ENDING and not out.is_dir() else out, "--out")
    recording = file_names(recorder).next(time.time_ns())
    if recording.exists():
        raise InputError(f"--out {out}: a recording of that name exists; choose another name, or a folder")
    recorder = msgspec.structs.replace(recorder, about={**about, **recorder.about})
    return write_node_settings(recording.with_suffix(".toml"), recorder, others, join, nodes)
