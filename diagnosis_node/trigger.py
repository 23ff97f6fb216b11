"""Trigger of diagnoses of a live plant. Pure: it processes messages and calls a function.

A diagnosis needs data after the onset of a fault. So it starts `after_min` of plant time after the alarm, on the
samples of the last `window_min`, which include those before the alarm. Alarms raised meanwhile, or within `apart_min`
of it, are attributed to the same fault.

If the plant stops or no data arrive while a diagnosis is pending, it starts with the available samples.
"""

from collections import deque
from collections.abc import Callable, Mapping
from math import inf
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, NamedTuple

import msgspec

from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.keys import DEFAULT_PLANT, check_plant
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, CommandReply, Sample
from reactorwatch.records.record import MINUTE_NS, NEVER_NS
from reactorwatch.runtime.setting_rules import check_bounds

HIDDEN_STATES = (
    AlarmState.ALARM_STATE_SHELVED,
    AlarmState.ALARM_STATE_SUPPRESSED_BY_DESIGN,
    AlarmState.ALARM_STATE_OUT_OF_SERVICE,
)
"""States of alarms that trigger no diagnosis."""

NO_DATA = "silence/"
"""Start of the names of alarms about missing data, which no model explains."""

MAX_SAMPLES = 300_000
"""Largest number of stored samples, at any sampling rate."""

TIMEOUT_NS = 60 * 10**9
"""Time without a sample after which the plant is considered stopped."""


class DiagnosisConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of diagnoses after alarms.

    Attributes:
        plant: name of the plant.
        out: folder for the reports, one subfolder each; None diagnoses nothing.
        window_min: length of the diagnosed record, in minutes of plant time.
        after_min: delay from the alarm to the diagnosis, in minutes of plant time.
        apart_min: minutes after a diagnosis in which alarms are attributed to the same fault.
        process: process of the plant, by name or file; the causes in an extended model are known already. None: the
            nominal reactor.
        tolerance: differences without practical significance, by output, in its unit.
    """

    plant: str = DEFAULT_PLANT
    out: str | None = None
    window_min: Annotated[float, msgspec.Meta(ge=20.0, le=1e6)] = 240.0
    after_min: Annotated[float, msgspec.Meta(ge=1.0, le=1e6)] = 30.0
    apart_min: Annotated[float, msgspec.Meta(ge=0.0, le=1e6)] = 60.0
    process: str | None = None
    tolerance: dict[str, float] = {}

    older_keys: ClassVar[Mapping[str, tuple[str, Callable[[Any], Any]]]] = MappingProxyType(
        {"model": ("process", lambda name: name)}
    )
    """Older names of keys, each with the present one and the function from a value of the older to one of it."""

    def __post_init__(self) -> None:
        check_plant(self.plant)
        check_bounds(DiagnosisConfig, msgspec.structs.asdict(self))
        for output, value in self.tolerance.items():
            if not 0.0 < value < inf:
                raise ValueError(f"tolerance of {output} must be a positive number, got {value:g}")
        if not self.after_min < self.window_min:
            raise ValueError(
                f"window_min must be more than after_min, got {self.window_min:g} and {self.after_min:g}; "
                "a diagnosis needs data from before the alarm"
            )


class DiagnosisRequest(NamedTuple):
    """Request for a diagnosis.

    Attributes:
        alarm: name of the alarm.
        raised_ns: time at which it was raised.
        samples: (sample time, published message) in the order of receipt.
    """

    alarm: str
    raised_ns: int
    samples: tuple[tuple[int, Encoded], ...]


class DiagnosisTrigger:
    """Starts a diagnosis after an alarm.

    Args:
        config: settings.
        diagnose: starts a diagnosis, without waiting for its end.
        busy: returns True while a diagnosis runs, which delays the next one.

    Attributes:
        waiting: alarm of the pending diagnosis and the time when it was raised; None if there is none.
    """

    finished = False

    def __init__(
        self, config: DiagnosisConfig, diagnose: Callable[[DiagnosisRequest], None], busy: Callable[[], bool]
    ) -> None:
        self._config, self._diagnose, self._busy = config, diagnose, busy
        self._samples: deque[tuple[int, Encoded]] = deque(maxlen=MAX_SAMPLES)
        self.waiting: tuple[str, int] | None = None
        self._suppressed_until_ns = -NEVER_NS
        self._timeout_ns = NEVER_NS

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Process a sample or an alarm; other messages are ignored."""
        try:
            content = decode(message.payload, message.encoding)
        except DecodeError:
            return []
        if isinstance(content, Sample):
            self._timeout_ns = now_ns + TIMEOUT_NS
            self._keep(content.time_ns, message)
        elif isinstance(content, Alarm):
            self._on_alarm(content)
        return []

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """Refuse any command."""
        return CommandReply(accepted=False, text="this node has no commands"), []

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Start a pending diagnosis if no data arrive."""
        if self.waiting is not None and now_ns >= self._timeout_ns:
            self._timeout_ns = now_ns + TIMEOUT_NS
            self._start(self.waiting)
        return []

    def next_tick_ns(self) -> int:
        """Time at which the plant is considered stopped, if a diagnosis is pending."""
        return NEVER_NS if self.waiting is None else self._timeout_ns

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Publish nothing."""
        return []

    def _on_alarm(self, alarm: Alarm) -> None:
        is_raised = alarm.event == "raised" and alarm.state not in HIDDEN_STATES
        is_new = self.waiting is None and alarm.raised_ns >= self._suppressed_until_ns
        if is_raised and is_new and not alarm.alarm.startswith(NO_DATA):
            self.waiting = (alarm.alarm, alarm.raised_ns)

    def _keep(self, time_ns: int, message: Encoded) -> None:
        """Store a sample and drop those before the window; all are dropped if the plant's time steps back before it."""
        window_ns = int(self._config.window_min * MINUTE_NS)
        if self._samples and time_ns < self._samples[0][0]:
            self._samples.clear()
            self.waiting, self._suppressed_until_ns = None, -NEVER_NS
        self._samples.append((time_ns, message))
        while self._samples[0][0] < time_ns - window_ns:
            self._samples.popleft()
        if self.waiting is not None and time_ns >= self.waiting[1] + self._config.after_min * MINUTE_NS:
            self._start(self.waiting)

    def _start(self, waiting: tuple[str, int]) -> None:
        if self._busy() or not self._samples:
            return
        self.waiting = None
        self._suppressed_until_ns = self._samples[-1][0] + int(self._config.apart_min * MINUTE_NS)
        self._diagnose(DiagnosisRequest(*waiting, tuple(self._samples)))
