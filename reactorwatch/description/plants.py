"""Processes of the plants of a site: each plant's settings name one, by its name or by a pattern."""

from collections.abc import Mapping
from fnmatch import fnmatchcase

from reactorwatch.description.choice import ProcessChoice
from reactorwatch.description.process import Process


class PlantProcesses:
    """Processes by plant.

    Args:
        names: name or file of a process by plant, or by a pattern of plants such as `north_*`; a plant's own entry goes
            before patterns, and the first pattern counts.

    Raises:
        InputError: a process cannot be loaded.
    """

    def __init__(self, names: Mapping[str, str]) -> None:
        loaded = {name: ProcessChoice(name).load() for name in dict.fromkeys(names.values())}
        self._processes = {plant: loaded[name] for plant, name in names.items()}

    def find(self, plant: str) -> Process | None:
        """Process of a plant; None: it is not stated."""
        if plant in self._processes:
            return self._processes[plant]
        return next((item for pattern, item in self._processes.items() if fnmatchcase(plant, pattern)), None)
