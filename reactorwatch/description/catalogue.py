"""The catalogue of processes: those that are shipped, and installed ones (entry points)."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.metadata import EntryPoint, entry_points

from reactorwatch.description.process import Process, describe_model
from reactorwatch.errors import InputError
from reactorwatch.process import MODELS
from reactorwatch.process.model import ProcessModel

GROUP = "reactorwatch.processes"
"""Group of entry points by which other packages add processes: functions that return a `Process`."""

ALIASES = {"cascaded_tanks": "tanks"}
"""Other names of shipped processes."""


class Catalogue(Mapping[str, Callable[[], Process]]):
    """Functions that return processes, by name; a shipped process goes before an installed one of its name."""

    def __init__(self) -> None:
        shipped = {make().name: partial(_build_process, make) for make in MODELS}
        self._shipped: dict[str, Callable[[], Process]] = {
            **shipped,
            **{alias: shipped[name] for alias, name in ALIASES.items()},
        }
        self._installed = {item.name: item for item in entry_points(group=GROUP)}

    def __getitem__(self, name: str) -> Callable[[], Process]:
        """Function that returns the process of a name."""
        return self._shipped[name] if name in self._shipped else partial(_load, self._installed[name])

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(dict.fromkeys([*self._shipped, *self._installed]))

    def __len__(self) -> int:
        """Number of names."""
        return sum(1 for _ in self)


def _build_process(make: Callable[[], ProcessModel]) -> Process:
    return describe_model(make())


def _load(entry: EntryPoint) -> Process:
    """Call the function of an entry point.

    Raises:
        InputError: it cannot be imported, or does not return a process.
    """
    try:
        found = entry.load()()
    except Exception as error:  # code of another package may raise anything
        raise InputError(f"process {entry.name!r} of {entry.value}: {type(error).__name__}: {error}") from error
    return check_process(found, f"process {entry.name!r} of {entry.value}")


def check_process(found: object, name: str) -> Process:
    """Check that what a function of a user's code returned is a process; returns it.

    Raises:
        InputError: it is not.
    """
    if not isinstance(found, Process):
        raise InputError(f"{name}: must return a reactorwatch Process, got {type(found).__name__}")
    return found
