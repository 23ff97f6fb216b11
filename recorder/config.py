"""The settings of the recorder and of the replay."""

import math

import msgspec

from reactorwatch.contract import keys


class RecorderConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is recorded, and where to.

    Attributes:
        plant: the plant that the recorder reports its health under, and that a file is named after.
        out: the file, with the ending `.mcap`; or the folder for a file named `{plant}-{UTC time}.mcap`.
        key_expression: what is recorded.
        health_period_s: between two reports of health.
        flush_period_s: between two moments at which all that was received is handed to the file.
        linger_s: asked to stop, it goes on until nothing has come for this long, at most ten times as long: others
            have last words too.
    """

    plant: str = "cstr"
    out: str = "."
    key_expression: str = keys.EVERYTHING
    health_period_s: float = 5.0
    flush_period_s: float = 1.0
    linger_s: float = 0.5

    def __post_init__(self) -> None:
        keys.checked_plant(self.plant)
        for name in ("health_period_s", "flush_period_s", "linger_s"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value!r}")


class ReplayConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is played back, and how.

    Attributes:
        file: the recording, `.mcap`, or a record, `.csv`.
        rate: plant time over clock time: 1 plays as the plant ran, 60 an hour in a minute, inf as fast as it goes.
        plant: the plant's name on the bus; empty: as recorded (`cstr` for a CSV file).
        everything: play estimates, charts, alarms and faults too, not the samples alone.
        wait_for: nodes, by name, that must be alive before the first sample goes out.
        columns: a CSV file's own names for its columns, where it has others.
    """

    file: str
    rate: float = 1.0
    plant: str = ""
    everything: bool = False
    wait_for: tuple[str, ...] = ()
    columns: dict[str, str] = {}

    def __post_init__(self) -> None:
        if not self.rate > 0.0:
            raise ValueError(f"rate must be positive, got {self.rate!r}")
        if self.plant:
            keys.checked_plant(self.plant)
