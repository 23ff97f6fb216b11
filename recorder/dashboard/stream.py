"""A stream of Rerun's, and what everything drawn onto it has: a path, two timelines, and a look that is said once.

Two timelines carry every point: the time of the run, as a rule since its first sample, for people, and the time of the
sample, for those who compare with something else.
"""

import numpy as np
import rerun as rr
from numpy.typing import NDArray

APPLICATION = "reactorwatch"
RUN_TIME = "run time"
SAMPLE_TIME = "sample time"
BATCH_ROWS = 8192


class Stream:
    """What has been said on a recording stream once and for all.

    Args:
        recording: the stream.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._said: dict[str, object] = {}

    def say(self, path: str, key: object, what: rr.AsComponents) -> None:
        """Say something without a time, unless what was said there last is the same.

        Args:
            path: of the entity.
            key: equal if what is said is.
            what: it.
        """
        if self._said.get(path) != key:
            self._said[path] = key
            self._recording.log(path, what, static=True)

    def send(self, path: str, time_ns: NDArray[np.int64], zero_ns: int, columns: rr.ComponentColumnList) -> None:
        """Send columns, a row for each time.

        Args:
            path: of the entity.
            time_ns: of the samples that they speak of.
            zero_ns: the time that the run counts from.
            columns: the values.
        """
        self._recording.send_columns(path, _clocks(time_ns, zero_ns), columns, strict=True)

    def send_numbers(self, path: str, time_ns: NDArray[np.int64], zero_ns: int, value: NDArray[np.float64]) -> None:
        """Send the points of a line, in batches."""
        for start in range(0, time_ns.size, BATCH_ROWS):
            rows = slice(start, start + BATCH_ROWS)
            self.send(path, time_ns[rows], zero_ns, rr.Scalars.columns(scalars=value[rows]))


def path_of(*parts: str) -> str:
    """The path of an entity, from names of any kind."""
    return rr.new_entity_path(list(parts))


def _clocks(time_ns: NDArray[np.int64], zero_ns: int) -> list[rr.TimeColumn]:
    return [
        rr.TimeColumn(RUN_TIME, duration=(time_ns - zero_ns).astype("timedelta64[ns]")),
        rr.TimeColumn(SAMPLE_TIME, timestamp=time_ns.astype("datetime64[ns]")),
    ]
