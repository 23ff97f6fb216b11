"""Trigger of diagnoses of a live plant. Pure: it processes messages and calls a function.

A diagnosis needs data after the onset of a fault. So it starts `after_min` of plant time after the alarm, on the
samples of the last `window_min`, which include those before the alarm. Alarms raised meanwhile, or within `apart_min`
of it, are attributed to the same fault.

If the plant stops or no data arrive while a diagnosis is pending, it starts with the available samples.
"""

from collections import deque
from collections.abc import Callable
from typing import Annotated, ClassVar

import msgspec

from reactorwatch.contract.alarm_states import CODES, OUT_OF_SIGHT
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.keys import DEFAULT_PLANT, check_plant
from reactorwatch.contract.messages_pb2 import Alarm, Sample
from reactorwatch.errors import positive
from reactorwatch.records.record import MINUTE_NS, NEVER_NS
from reactorwatch.runtime.bus import Node
from reactorwatch.runtime.config import MODEL_IS_PROCESS, OlderKeys, check_bounds
from recorder import RecordedMessage

HIDDEN_STATES = frozenset(CODES[state] for state in OUT_OF_SIGHT)  # alarms that trigger no diagnosis
NO_DATA = "silence/"  # start of the names of alarms about missing data, which no model explains
TIMEOUT_NS = 60 * 10**9  # time without a sample after which the plant is considered stopped


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

    older_keys: ClassVar[OlderKeys] = MODEL_IS_PROCESS

    def __post_init__(self) -> None:
        check_plant(self.plant)
        check_bounds(DiagnosisConfig, msgspec.structs.asdict(self))
        for output, value in self.tolerance.items():
            positive(f"tolerance of {output}", value)
        if not self.after_min < self.window_min:
            raise ValueError(
                f"window_min must be more than after_min, got {self.window_min:g} and {self.after_min:g}; "
                "a diagnosis needs data from before the alarm"
            )


class DiagnosisTrigger(Node):
    """Starts a diagnosis after an alarm.

    Args:
        config: settings.
        diagnose: starts a diagnosis after an alarm, on samples in the order of receipt, without waiting for its end.
        busy: returns True while a diagnosis runs, which delays the next one.

    Attributes:
        waiting: alarm of the pending diagnosis; None if there is none.
    """

    def __init__(
        self,
        config: DiagnosisConfig,
        diagnose: Callable[[Alarm, list[RecordedMessage]], None],
        busy: Callable[[], bool],
    ) -> None:
        self._config, self._diagnose, self._busy = config, diagnose, busy
        self._samples: deque[RecordedMessage] = deque(maxlen=300_000)  # at any sampling rate
        self.waiting: Alarm | None = None
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
            is_raised = content.event == "raised" and content.state not in HIDDEN_STATES
            is_new = self.waiting is None and content.raised_ns >= self._suppressed_until_ns
            if is_raised and is_new and not content.alarm.startswith(NO_DATA):
                self.waiting = content
        return []

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Start a pending diagnosis if no data arrive."""
        if self.waiting is not None and now_ns >= self._timeout_ns:
            self._timeout_ns = now_ns + TIMEOUT_NS  # tried again then, if another diagnosis runs
            self._start()
        return []

    def next_tick_ns(self) -> int:
        """Time at which the plant is considered stopped, if a diagnosis is pending."""
        return NEVER_NS if self.waiting is None else self._timeout_ns

    def _keep(self, time_ns: int, message: Encoded) -> None:
        """Store a sample and drop those before the window; all are dropped if the plant's time steps back before it."""
        if self._samples and time_ns < self._samples[0].publish_time_ns:
            self._samples.clear()
            self.waiting, self._suppressed_until_ns = None, -NEVER_NS
        key, payload, encoding, received_ns = message
        self._samples.append(RecordedMessage(key, payload, encoding, received_ns or time_ns, time_ns))
        while self._samples[0].publish_time_ns < time_ns - int(self._config.window_min * MINUTE_NS):
            self._samples.popleft()
        if self.waiting is not None and time_ns >= self.waiting.raised_ns + self._config.after_min * MINUTE_NS:
            self._start()

    def _start(self) -> None:
        if self.waiting is None or self._busy() or not self._samples:
            return
        alarm, self.waiting = self.waiting, None
        self._suppressed_until_ns = self._samples[-1].publish_time_ns + int(self._config.apart_min * MINUTE_NS)
        self._diagnose(alarm, list(self._samples))
