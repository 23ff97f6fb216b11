"""Optional libraries: their import, and the data frames that need one."""

import importlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from reactorwatch.errors import InputError

if TYPE_CHECKING:
    from pandas import DataFrame


def import_optional(module: str, purpose: str) -> Any:
    """Import a module of an optional library.

    Args:
        module: name of the module.
        purpose: what it is needed for, for the error.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        library = module.partition(".")[0]
        raise InputError(
            f"{purpose} needs {library}, which is not installed: pip install 'reactorwatch[notebook]'"
        ) from error


def make_frame(columns: Mapping[str, Any], index: str | None = None) -> "DataFrame":
    """Make a pandas data frame of columns.

    Args:
        columns: values by column, all of one length.
        index: name of the column that becomes the index; None: rows are numbered.

    Raises:
        InputError: pandas is not installed.
    """
    frame = import_optional("pandas", "to_frame()").DataFrame(dict(columns))
    return frame if index is None else frame.set_index(index)


def frame_of_rows(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> "DataFrame":
    """Make a pandas data frame of rows; without rows it has the columns `names` alone.

    Raises:
        InputError: pandas is not installed.
    """
    return make_frame({name: [row[name] for row in rows] for name in names})
