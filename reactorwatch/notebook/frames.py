"""Data frames of results."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from reactorwatch.notebook.extra import import_optional

if TYPE_CHECKING:
    from pandas import DataFrame


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
