"""Wrapper of a Rerun stream with two timelines, which logs static data once.

Every point is on both timelines: the time of the run, usually since its first sample, for people, and the sample time,
for comparison with other data.
"""

import numpy as np
import rerun as rr
from numpy.typing import NDArray

APPLICATION = "reactorwatch"
RUN_TIME = "run time"
SAMPLE_TIME = "sample time"
BATCH_ROWS = 8192


class Stream:
    """Rerun stream that logs static data once.

    Args:
        recording: the stream.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._static_keys: dict[str, object] = {}

    def log_static(self, path: str, key: object, data: rr.AsComponents) -> None:
        """Log static data, unless equal data were logged last.

        Args:
            path: path of the entity.
            key: key that is equal for equal data.
            data: the data.
        """
        if self._static_keys.get(path) != key:
            self._static_keys[path] = key
            self._recording.log(path, data, static=True)

    def send(self, path: str, time_ns: NDArray[np.int64], zero_ns: int, columns: rr.ComponentColumnList) -> None:
        """Send columns, a row for each time.

        Args:
            path: path of the entity.
            time_ns: sample times.
            zero_ns: time that minutes count from.
            columns: the values.
        """
        self._recording.send_columns(path, _clocks(time_ns, zero_ns), columns, strict=True)

    def send_series(self, path: str, time_ns: NDArray[np.int64], zero_ns: int, value: NDArray[np.float64]) -> None:
        """Send the points of a line, in batches."""
        for start in range(0, time_ns.size, BATCH_ROWS):
            rows = slice(start, start + BATCH_ROWS)
            self.send(path, time_ns[rows], zero_ns, rr.Scalars.columns(scalars=value[rows]))


def path_of(*parts: str) -> str:
    """Path of an entity, from names with any characters."""
    return rr.new_entity_path(list(parts))


def _clocks(time_ns: NDArray[np.int64], zero_ns: int) -> list[rr.TimeColumn]:
    return [
        rr.TimeColumn(RUN_TIME, duration=(time_ns - zero_ns).astype("timedelta64[ns]")),
        rr.TimeColumn(SAMPLE_TIME, timestamp=time_ns.astype("datetime64[ns]")),
    ]
