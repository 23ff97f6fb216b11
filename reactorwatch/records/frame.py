"""Data frames of any library as files of tables."""

from pathlib import Path
from typing import Any

from reactorwatch.errors import InputError


def write_frame(frame: Any, path: Path) -> Path:
    """Write a data frame (pandas, polars, Arrow) as a Parquet file; returns its path.

    Raises:
        InputError: the frame has columns that are no plain values.
    """
    import pyarrow as pa
    import pyarrow.parquet

    try:
        pyarrow.parquet.write_table(pa.table(frame), path)
    except (pa.ArrowException, TypeError) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(f"data frame: expected columns of plain values: {reason}") from error
    return path
