"""Settings of a plant and of the processes of a run, from a settings file and the flags of a command."""

from typing import Any

from plant_node.config import PlantConfig
from reactorwatch.description.find import find_process
from reactorwatch.runtime.config import section
from recorder.tools.convert import plant_name

Tables = dict[str, dict[str, Any]]


def load_plant_settings(tables: Tables, flags: dict[str, Any]) -> PlantConfig:
    """Settings of a plant; one whose process the flags name is named after it.

    Args:
        tables: tables of the settings file.
        flags: flags by key; None: not given.

    Raises:
        InputError: invalid settings, or there is no such process.
    """
    process = flags.get("process")
    if process is not None and not (flags.get("name") or "name" in tables.get("plant", {})):
        flags = {**flags, "name": plant_name(None, find_process(process))}
    return section(PlantConfig, "plant", tables, flags)
