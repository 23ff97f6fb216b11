"""The settings of the recorder and of the replay."""

import math

import msgspec

from reactorwatch.contract import keys
from recorder.policy.room import MOST_KEYS
from recorder.policy.rotation import Fsync

LONGEST_FLUSH_S = 1.0
FEWEST_KEYS = 100


class RecorderConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is recorded, and where to.

    Attributes:
        plant: the plant that the recorder reports its health under, and that a file is named after.
        out: the file, with the ending `.mcap`; or the folder for a file named `{plant}-{UTC time}.mcap`. A folder that
            does not exist is made.
        key_expression: what is recorded.
        health_period_s: between two reports of health.
        flush_period_s: between two moments at which all that was received is handed to the operating system: what a
            recorder that is killed may lose. At most a second.
        fsync: when to wait until what was handed over is on the disk, for the case that the machine loses its power:
            `never`, after each `chunk` that was handed over, or once a `second`.
        rotate_min: age of a file, in minutes, at which a new one is begun; inf: never.
        rotate_mb: its size, likewise.
        keep_mb: size of all files together beyond which the oldest is deleted; inf: never.
        keep_days: age of a file since its end, in days in which the machine ran, beyond which it is deleted; inf:
            never.
        keep_files: number of files beyond which the oldest is deleted; inf: never.
        most_keys: keys with messages of the product that a file has room for; a thousand take about 1.5 MB of
            memory. Messages on more keys are not recorded; the alarm `recording/keys` says so.
        black_box_min: minutes before and after each alarm that are kept in a file of their own, which is never
            deleted; 0: none.
        resume_mb: with a full disk, recording goes on when there is this much room again.
        about: what else each file should say about its origin, such as the seed of a simulated plant.
        linger_s: asked to stop, it goes on until nothing has come for this long, at most ten times as long: others
            have last words too.
    """

    plant: str = "cstr"
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
    most_keys: int = MOST_KEYS
    black_box_min: float = 10.0
    resume_mb: float = 50.0
    linger_s: float = 0.5
    about: dict[str, str] = {}

    def __post_init__(self) -> None:
        keys.check_plant(self.plant)
        keys.check_expression(self.key_expression)
        for name in ("health_period_s", "flush_period_s", "linger_s"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value!r}")
        if self.flush_period_s > LONGEST_FLUSH_S:
            raise ValueError(f"flush_period_s must be at most {LONGEST_FLUSH_S:g}, got {self.flush_period_s!r}")
        for name in ("rotate_min", "rotate_mb", "keep_mb", "keep_days"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, or inf, got {getattr(self, name)!r}")
        if not self.keep_files >= 1.0:
            raise ValueError(f"keep_files must be at least 1, or inf, got {self.keep_files!r}")
        if not FEWEST_KEYS <= self.most_keys <= MOST_KEYS:
            raise ValueError(f"most_keys must be in [{FEWEST_KEYS}, {MOST_KEYS}], got {self.most_keys!r}")
        for name in ("black_box_min", "resume_mb"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and not negative, got {getattr(self, name)!r}")


class ReplayConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is played back, and how.

    Attributes:
        file: the recording, `.mcap`, or a record, `.csv`.
        rate: plant time over clock time: 1 plays as the plant ran, 60 an hour in a minute, inf as fast as it goes.
        from_min: where it begins, in minutes since the first sample; of a CSV file by its own time.
        to_min: where it ends, likewise.
        loop: whether it begins anew at the end.
        plant: the plant's name on the bus; empty: as recorded (`cstr` for a CSV file).
        everything: play estimates, charts, alarms and faults too, not the samples alone.
        wait_for: nodes, by name, that must be alive before the first sample goes out.
        columns: a CSV file's own names for its columns, where it has others.
    """

    file: str
    rate: float = 1.0
    from_min: float = -math.inf
    to_min: float = math.inf
    loop: bool = False
    plant: str = ""
    everything: bool = False
    wait_for: tuple[str, ...] = ()
    columns: dict[str, str] = {}

    def __post_init__(self) -> None:
        if not self.rate > 0.0:
            raise ValueError(f"rate must be positive, got {self.rate!r}")
        if not self.from_min < self.to_min:
            raise ValueError(f"from_min must be before to_min, got {self.from_min:g} and {self.to_min:g}")
        if self.plant:
            keys.check_plant(self.plant)
