"""Which alarms of a live plant are diagnosed, when, and on which samples.

Pure: messages in, and a call of whoever diagnoses. An alarm by itself says that something has happened; to tell what,
a diagnosis needs to see it go on for a while. So it waits for `after_min` of the plant, and then takes the samples of
the last `window_min`, those before the alarm among them. Alarms that come meanwhile, or within `apart_min` of it, are
taken for the same trouble.

A plant that ends, or falls silent, while one waits is diagnosed by what there is.
"""

from collections import deque
from collections.abc import Callable
from math import inf
from typing import NamedTuple

import msgspec

from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.keys import check_plant
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, CommandReply, Sample
from reactorwatch.records.record import MINUTE_NS

OUT_OF_SIGHT = (
    AlarmState.ALARM_STATE_SHELVED,
    AlarmState.ALARM_STATE_SUPPRESSED_BY_DESIGN,
    AlarmState.ALARM_STATE_OUT_OF_SERVICE,
)
"""States of alarms that nobody wants to hear of."""

SILENCE = "silence/"
"""What the names of alarms begin with that no model explains: nothing comes."""

MOST_SAMPLES = 300_000
"""That are kept, however often the plant is sampled."""

SILENT_NS = 60 * 10**9
"""Of waiting for the next sample, after which the plant is taken to have ended."""

NEVER_NS = 2**62


class DiagnosisConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Diagnoses after alarms.

    Attributes:
        plant: its name.
        out: folder for the reports, a folder in it for each; None: nothing is diagnosed.
        window_min: how much of the past is diagnosed, in minutes of the plant ...
        after_min: ... so long after the alarm was raised.
        apart_min: alarms of so many minutes after a diagnosis are taken for the same trouble.
        model: file of an extended model, what is known already; None: the nominal reactor.
        tolerance: differences that do not matter, by output, in its unit.
    """

    plant: str = "cstr"
    out: str | None = None
    window_min: float = 240.0
    after_min: float = 30.0
    apart_min: float = 60.0
    model: str | None = None
    tolerance: dict[str, float] = {}

    def __post_init__(self) -> None:
        check_plant(self.plant)
        for what, value, low in (("window_min", self.window_min, 20.0), ("after_min", self.after_min, 1.0)):
            if not low <= value <= 1e6:
                raise ValueError(f"{what} must be in [{low:g}, 1e+06], got {value:g}")
        if not 0.0 <= self.apart_min <= 1e6:
            raise ValueError(f"apart_min must be in [0, 1e+06], got {self.apart_min:g}")
        for output, value in self.tolerance.items():
            if not 0.0 < value < inf:
                raise ValueError(f"tolerance of {output} must be a positive number, got {value:g}")
        if not self.after_min < self.window_min:
            raise ValueError(
                f"window_min must be more than after_min, got {self.window_min:g} and {self.after_min:g}; "
                "a diagnosis needs to see the plant before the alarm"
            )


class Asked(NamedTuple):
    """A diagnosis that is due.

    Attributes:
        alarm: that was raised.
        raised_ns: when.
        samples: their times and themselves as they were published, in the order of their receipt.
    """

    alarm: str
    raised_ns: int
    samples: tuple[tuple[int, Encoded], ...]


class AfterAlarm:
    """Asks for a diagnosis after alarms.

    Args:
        config: settings.
        diagnose: begins a diagnosis, without waiting for its end.
        busy: whether one is under way; then the next waits.
    """

    finished = False

    def __init__(self, config: DiagnosisConfig, diagnose: Callable[[Asked], None], busy: Callable[[], bool]) -> None:
        self._config, self._diagnose, self._busy = config, diagnose, busy
        self._samples: deque[tuple[int, Encoded]] = deque(maxlen=MOST_SAMPLES)
        self._waiting: tuple[str, int] | None = None
        self._deaf_until_ns = -NEVER_NS
        self._look_ns = NEVER_NS

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Take in a sample or an alarm; what is neither is left alone."""
        try:
            said = decode(message.payload, message.encoding)
        except DecodeError:
            return []
        if isinstance(said, Sample):
            self._look_ns = now_ns + SILENT_NS
            self._keep(said.time_ns, message)
        elif isinstance(said, Alarm):
            self._on_alarm(said)
        return []

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Nobody asks."""
        return CommandReply(accepted=False, text="nothing can be asked here"), []

    def on_tick(self, now_ns: int) -> list[Publication]:
        """The plant is silent: diagnose what there is."""
        if self._waiting is not None and now_ns >= self._look_ns:
            self._look_ns = now_ns + SILENT_NS
            self._begin(self._waiting)
        return []

    def next_tick_ns(self) -> int:
        """When a plant that says nothing more is taken to have ended."""
        return NEVER_NS if self._waiting is None else self._look_ns

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Nothing is left to say."""
        return []

    @property
    def waiting(self) -> str | None:
        """The alarm that will be diagnosed next."""
        return None if self._waiting is None else self._waiting[0]

    def _on_alarm(self, alarm: Alarm) -> None:
        comes_up = alarm.event == "raised" and alarm.state not in OUT_OF_SIGHT
        if not comes_up or alarm.alarm.startswith(SILENCE):
            return
        if self._waiting is None and alarm.raised_ns >= self._deaf_until_ns:
            self._waiting = (alarm.alarm, alarm.raised_ns)

    def _keep(self, time_ns: int, message: Encoded) -> None:
        """The samples of the window; a plant whose time goes far back has begun anew, and what was is forgotten."""
        window_ns = int(self._config.window_min * MINUTE_NS)
        if self._samples and time_ns < self._samples[0][0]:
            self._samples.clear()
            self._waiting, self._deaf_until_ns = None, -NEVER_NS
        self._samples.append((time_ns, message))
        while self._samples[0][0] < time_ns - window_ns:
            self._samples.popleft()
        if self._waiting is not None and time_ns >= self._waiting[1] + self._config.after_min * MINUTE_NS:
            self._begin(self._waiting)

    def _begin(self, waiting: tuple[str, int]) -> None:
        if self._busy() or not self._samples:
            return
        self._waiting = None
        self._deaf_until_ns = self._samples[-1][0] + int(self._config.apart_min * MINUTE_NS)
        self._diagnose(Asked(*waiting, tuple(self._samples)))
