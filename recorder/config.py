"""The settings of the recorder and of the replay."""

import math
from typing import Annotated

import msgspec

from reactorwatch.contract import keys
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.runtime.config import check_bounds
from recorder.keep import MAX_KEYS, Fsync

MB = 1_000_000


class RecorderConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the recorder.

    Attributes:
        plant: plant that the recorder reports its health under and that files are named after.
        out: the file, with the ending `.mcap`; or the folder for files named `{plant}-{UTC time}.mcap`, which is
            created if it does not exist.
        key_expression: keys to record.
        health_period_s: time between two health reports.
        flush_period_s: time between two flushes to the operating system, which is what a recorder that is killed may
            lose. At most a second.
        fsync: policy of syncing flushed data to the disk, against power loss: `never`, after each flushed `chunk`, or
            once a `second`.
        rotate_min: age of a file, in minutes, at which a new one is started; inf never starts one.
        rotate_mb: size of a file, in megabytes, at which a new one is started; inf never starts one.
        keep_mb: total size of all files, in megabytes, beyond which the oldest is deleted; inf deletes none.
        keep_days: age of a file since its end, in days in which the machine ran, beyond which it is deleted; inf
            deletes none.
        keep_files: number of files beyond which the oldest is deleted; inf deletes none.
        most_keys: largest number of keys of the product in a file; a thousand take about 1.5 MB of memory. Messages on
            more keys are not recorded, and the alarm `recording/keys` is raised.
        black_box_min: minutes before and after each alarm that are copied into a file of their own, which is never
            deleted; 0 copies none.
        resume_mb: free disk space, in megabytes, at which recording resumes after a full disk.
        processes: process by plant, a name in the catalogue or a file, as which each file describes the plant's
            signals; a key may be a pattern of plants such as `north_*`. Of other plants nothing is described.
        about: additional metadata of each file, such as the seed of a simulated plant.
        linger_s: after a stop is requested, recording ends when no message has arrived for this long, at most after ten
            times this long, so that the last messages of other nodes are recorded.
    """

    plant: str = keys.DEFAULT_PLANT
    out: str = "."
    key_expression: str = keys.EVERYTHING
    health_period_s: float = 5.0
    flush_period_s: float = 0.5
    fsync: Fsync = "second"
    rotate_min: float = 60.0
    rotate_mb: float = 1000.0
    keep_mb: float = math.inf
    keep_days: float = math.inf
    keep_files: float = math.inf
    most_keys: Annotated[int, msgspec.Meta(ge=100, le=MAX_KEYS)] = MAX_KEYS
    black_box_min: float = 10.0
    resume_mb: float = 50.0
    linger_s: float = 0.5
    processes: dict[str, str] = {}
    about: dict[str, str] = {}

    def __post_init__(self) -> None:
        keys.check_plant(self.plant)
        keys.check_expression(self.key_expression)
        for name in ("health_period_s", "flush_period_s", "linger_s"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value!r}")
        if self.flush_period_s > 1.0:  # the promise about a recorder that is killed
            raise ValueError(f"flush_period_s must be at most 1, got {self.flush_period_s!r}")
        for name in ("rotate_min", "rotate_mb", "keep_mb", "keep_days"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, or inf, got {getattr(self, name)!r}")
        if not self.keep_files >= 1.0:
            raise ValueError(f"keep_files must be at least 1, or inf, got {self.keep_files!r}")
        check_bounds(RecorderConfig, msgspec.structs.asdict(self))
        for name in ("black_box_min", "resume_mb"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {getattr(self, name)!r}")


class ReplayConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the replay.

    Attributes:
        file: the recording, `.mcap`, or a record, `.csv`.
        rate: plant time over clock time: 1 plays in real time, 60 an hour in a minute, inf as fast as possible.
        from_min: start, in minutes since the first sample; for a CSV file in its own time.
        to_min: end, in the minutes of `from_min`.
        loop: True to restart at the end.
        plant: name of the plant on the bus; empty keeps the recorded name (for a table, that of its process).
        everything: True to play all that the monitor published, and faults, not only samples.
        wait_for: names of nodes that must be alive before the first sample is published.
        process: process whose signals are played, by name or file; None: all signals of a recording, those of the
            reactor in a table.
        inputs: columns of a table that are inputs, without a process.
        outputs: columns of a table that are outputs, without a process.
        columns: names of the columns in a table, by signal, where they differ.
        table: form of a table, where it is not to be guessed.
    """

    file: str
    rate: float = 1.0
    from_min: float = -math.inf
    to_min: float = math.inf
    loop: bool = False
    plant: str = ""
    everything: bool = False
    wait_for: tuple[str, ...] = ()
    process: str | None = None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    columns: dict[str, str] = {}
    table: FileFormat = GUESS

    def __post_init__(self) -> None:
        if not self.rate > 0.0:
            raise ValueError(f"rate must be positive, got {self.rate!r}")
        if not self.from_min < self.to_min:
            raise ValueError(f"from_min must be before to_min, got {self.from_min:g} and {self.to_min:g}")
        if self.plant:
            keys.check_plant(self.plant)
