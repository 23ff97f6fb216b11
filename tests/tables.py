"""Records of the reactor as tables, for tests."""

from collections.abc import Mapping
from pathlib import Path

from reactorwatch.description.read import find_process, read_process_table
from reactorwatch.records.record import Record

REACTOR = find_process().without_equations()
UNITS = REACTOR.units


def read_csv(path: Path, columns: Mapping[str, str] | None = None) -> Record:
    """Read a record of the reactor in the units of its columns."""
    return read_process_table(path, REACTOR, columns)
