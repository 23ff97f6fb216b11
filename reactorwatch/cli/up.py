"""`up`: run the router in this process and the nodes as processes, until stopped."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import msgspec
import structlog

from diagnosis_node.trigger import DiagnosisConfig
from monitor_node.config import MonitorConfig
from monitor_node.watch.evaluation import check_promise
from plant_node.config import PlantConfig, fit_settings
from plant_node.record import load_process
from reactorwatch.api.files import record
from reactorwatch.cli.kernels import compile_at_first_start
from reactorwatch.cli.option_groups import BusOptions, stated_settings
from reactorwatch.cli.options import check_recording
from reactorwatch.cli.processes import (
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
from reactorwatch.description.find import DEFAULT_PROCESS, find_in_catalogue, find_process
from reactorwatch.diagnosis.practical_significance import check_tolerance
from reactorwatch.errors import InputError
from reactorwatch.limits import limits
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.records.folder import make_folder
from reactorwatch.records.output import check_folder_name
from reactorwatch.records.source_text import is_table
from reactorwatch.runtime.config import BusConfig, LogConfig, MetricsConfig, read_settings, section
from reactorwatch.runtime.event_loop import stop_on_signals
from reactorwatch.runtime.logs import configure
from recorder.config import RecorderConfig, ReplayConfig
from recorder.files.recording import Recording
from recorder.keep import ENDING
from recorder.recording_files import file_names
from recorder.tools.convert import plant_name

Tables = dict[str, dict[str, Any]]
WAIT_FOR = ("monitor", "recorder")
"""Nodes that must be alive before the first sample."""


class PlayedRecord(NamedTuple):
    """A record that is played in place of a simulated plant.

    Attributes:
        path: a recording or a table.
        stated: statements about the form of a table.
    """

    path: Path
    stated: FileFormat = GUESS


@dataclass(frozen=True)
class Source:
    """Source of a run's samples.

    Attributes:
        node: `plant` or `replay`.
        settings: settings of the node.
        plant: name of the plant.
        process: name or file of the process.
        is_named: True if flags or a recording name the process, False if it is that of the plant's settings.
        rows: number of rows of a played record, of which a third is the longest training; None: it does not matter.
    """

    node: str
    settings: PlantConfig | ReplayConfig
    plant: str
    process: str
    is_named: bool
    rows: int | None = None

    @property
    def has_end(self) -> bool:
        """True if the source ends by itself."""
        settings = self.settings
        return settings.rows is not None if isinstance(settings, PlantConfig) else not settings.loop

    @property
    def about(self) -> dict[str, str]:
        """Metadata of the recording."""
        settings = self.settings
        return {"seed": str(settings.seed)} if isinstance(settings, PlantConfig) else {"source": settings.file}

    def monitor_flags(self, tables: Tables) -> dict[str, Any]:
        """Settings of the monitor that follow from the source, as flags.

        The monitor of a plant whose settings name an extended model judges by the equations that its own settings name,
        so that the deviations of the plant are found.
        """
        flags: dict[str, Any] = {"plant": self.plant}
        stated = tables.get("monitor", {}).keys() & {"process", "model", "input", "inputs", "outputs"}
        is_catalogued = self.process != DEFAULT_PROCESS and not self.process.lower().endswith(".json")
        if self.is_named or (is_catalogued and not stated):
            flags["process"] = self.process
        is_stated = tables.get("monitor", {}).keys() & {"training_min", "training_rows"}
        if self.rows is not None and not is_stated:
            from monitor_node.config import DEFAULT_TRAINING_ROWS  # only here: a plant needs no charts

            flags["training_rows"] = max(1, min(DEFAULT_TRAINING_ROWS, self.rows // 3))
        return flags


def load_source(tables: Tables, flags: dict[str, Any], played: PlayedRecord | None) -> Source:
    """Settings of the source of a run's samples."""
    if played is None:
        waiting = {"plant": {"wait_for": list(WAIT_FOR), **tables.get("plant", {})}}
        plant = complete_plant_settings(load_plant_settings(waiting, flags))
        return Source(
            "plant", plant, plant.name, plant.process or DEFAULT_PROCESS, is_named=flags.get("process") is not None
        )
    given = flags.get("process") or tables.get("replay", {}).get("process")
    process, name = _played_process(played.path, given, flags.get("name"))
    replay = _replay_settings(tables, played, {**flags, "name": name, "process": process})
    is_named, rows = process != DEFAULT_PROCESS, None
    if is_named:
        described = find_process(process).without_equations()
        rows = record(played.path, None, replay.columns, described, replay.table).rows
    return Source("replay", replay, name, process, is_named=is_named, rows=rows)


def load_plant_settings(tables: Tables, flags: dict[str, Any]) -> PlantConfig:
    """Settings of a plant; one whose process the flags name is named after it."""
    process = flags.get("process")
    if process is not None and not (flags.get("name") or "name" in tables.get("plant", {})):
        flags = {**flags, "name": plant_name(None, find_process(process))}
    return section(PlantConfig, "plant", tables, flags)


def complete_plant_settings(config: PlantConfig) -> PlantConfig:
    """Settings in which what the process decides is written out."""
    changed, process = load_process(config)
    return fit_settings(changed, process).complete(config)


def _replay_settings(tables: Tables, played: PlayedRecord, flags: dict[str, Any]) -> ReplayConfig:
    """Settings of a replay in place of a plant."""
    for name, option in (("seed", "--seed"), ("faults", "--fault")):
        if flags.get(name) is not None:
            raise InputError(f"--record {played.path}: a record is played, not simulated; leave {option} out")
    given = {
        "file": str(check_recording(played.path)),
        "plant": flags["name"],
        "rate": flags.get("speed"),
        "process": flags["process"],
        "table": stated_settings(played.stated),
    }
    waiting = {"wait_for": list(WAIT_FOR), **tables.get("replay", {})}
    return section(ReplayConfig, "replay", {"replay": waiting}, given)


def _played_process(path: Path, process: str | None, plant: str | None) -> tuple[str, str]:
    """Process of a played record, by name or file, and the name of its plant."""
    if not is_table(path):
        recording = Recording(path)
        recorded = recording.one_plant()
        plant, described = plant or recorded, recording.process(recorded)
        if process is None and described is not None:
            process = described.name
            find_in_catalogue(process, f"--record {path}")
    process = process or DEFAULT_PROCESS
    return process, plant_name(plant, find_process(process))


log = structlog.get_logger()
POLL_S = 0.5
DEFAULT_OUT = "runs"
"""Default folder of recordings."""


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
    configure(as_json=log_config.format == "json")
    source = load_source(tables, flags, played)
    monitor = section(MonitorConfig, "monitor", tables, source.monitor_flags(tables))
    if isinstance(source.settings, PlantConfig):
        try:
            check_promise(monitor, source.settings.period_min)
        except InputError as error:
            raise InputError(f"settings [monitor]: {error}") from error
    of_recorder = tables.get("recorder", {})
    processes = {source.plant: source.process, **of_recorder.get("processes", {})}
    of_recorder = {"recorder": {"out": DEFAULT_OUT, **of_recorder, "processes": processes}}
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
    recording = file_names(recorder).first(datetime.now(UTC))
    if recording.exists():
        raise InputError(f"--out {out}: a recording of that name exists; choose another name, or a folder")
    recorder = msgspec.structs.replace(recorder, about={**about, **recorder.about})
    return write_node_settings(recording.with_suffix(".toml"), recorder, others, join, nodes)
