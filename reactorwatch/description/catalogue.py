"""The catalogue of processes: those that are shipped, and installed ones (entry points)."""

from collections.abc import Callable
from functools import partial
from importlib.metadata import EntryPoint, entry_points

from reactorwatch.description.process import Process, describe_model
from reactorwatch.errors import InputError, describe_exception
from reactorwatch.process import MODELS

GROUP = "reactorwatch.processes"
"""Group of entry points by which other packages add processes: functions that return a `Process`."""

ALIASES = {"cascaded_tanks": "tanks"}
"""Other names of shipped processes."""


def catalogue() -> dict[str, Callable[[], Process]]:
    """Functions that return processes, by name; a shipped process goes before an installed one of its name."""
    models = [make() for make in MODELS]
    shipped: dict[str, Callable[[], Process]] = {model.name: partial(describe_model, model) for model in models}
    shipped |= {alias: shipped[name] for alias, name in ALIASES.items()}
    installed = {item.name: partial(_load, item) for item in entry_points(group=GROUP)}
    return {**shipped, **{name: load for name, load in installed.items() if name not in shipped}}


def _load(entry: EntryPoint) -> Process:
    """Call the function of an entry point."""
    name = f"process {entry.name!r} of {entry.value}"
    try:
        found = entry.load()()
    except Exception as error:  # code of another package may raise anything
        raise InputError(f"{name}: {describe_exception(error)}") from error
    return check_process(found, name)


def check_process(found: object, name: str) -> Process:
    """Check that what a function of a user's code returned is a process; returns it.

    Raises:
        InputError: it is not.
    """
    if not isinstance(found, Process):
        raise InputError(f"{name}: must return a reactorwatch Process, got {type(found).__name__}")
    return found
