"""Settings of the source of a run's samples: a simulated plant, or a played record."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from plant_node.config import PlantConfig, fit_settings
from plant_node.record import load_process
from reactorwatch.api.files import record
from reactorwatch.cli.option_groups import stated_settings
from reactorwatch.cli.options import check_recording
from reactorwatch.description.read import find_in_catalogue, find_process
from reactorwatch.errors import InputError
from reactorwatch.process import DEFAULT_PROCESS
from reactorwatch.records.decode import is_table
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.runtime.config import section
from recorder.config import ReplayConfig
from recorder.files.recording import Recording
from recorder.tools.convert import plant_name

Tables = dict[str, dict[str, Any]]
WAIT_FOR = ("monitor", "recorder")
"""Nodes that must be alive before the first sample."""


class PlayedRecord(NamedTuple):
    """A record that is played in place of a simulated plant."""

    path: Path
    stated: FileFormat = GUESS


@dataclass(frozen=True)
class Source:
    """Source of a run's samples."""

    node: str  # `plant` or `replay`
    settings: PlantConfig | ReplayConfig
    plant: str
    process: str
    is_named: bool  # False: the process is that of the plant's settings
    rows: int | None = None  # of a played record; a third of them is the longest training

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
