"""Promise of false alarms and power of a plant, as commands state them: with three digits."""

from typing import Any, Self

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.results.base import Result

HORIZONS = ("within_10_min", "within_1_h", "within_1_day")


class Promise(Result, frozen=True):
    """Promise of false alarms, and how training and rows bear it out.

    Attributes:
        expected: false alarms expected on average: in 30 days on the bus, in the judged rows of a back-test.
        expected_90: upper bound of them for this plant, with 90 % confidence.
        checked_rows: rows of the training that were judged by the rows before them; 0: it was too short.
        found_in_training: alarms in these rows.
        expected_in_training: false alarms promised in them.
        kept: False if the training shows that the promise cannot be kept.
        can_keep_per_30_days: the promise that can be.
        text: one sentence.
        rows: rows judged since the training.
        found: alarms in these rows that chance can raise.
        expected_so_far: false alarms promised in them.
        drifted: True if more alarms came than chance explains.
    """

    expected: float
    expected_90: float
    checked_rows: int
    found_in_training: int
    expected_in_training: float
    kept: bool
    can_keep_per_30_days: float
    text: str
    rows: int
    found: int
    expected_so_far: float
    drifted: bool

    @classmethod
    def of(cls, message: messages.Promise) -> Self:
        """The promise of a message."""
        values: dict[str, Any] = {}
        for name in cls.__struct_fields__:
            value = getattr(message, name)
            values[name] = three_digits(value) if isinstance(value, float) else value
        return cls(**values)


class Power(Result, frozen=True, kw_only=True):
    """Sizes of a deviation that are seen in nine of ten cases, by horizon; None: none within its bounds.

    Attributes:
        deviation: a cause of the catalogue, or `{signal}.bias`.
        unit: unit of the sizes.
        profile: `ramp`: the sizes are those reached in a day; empty: a step.
        within_10_min: size that is seen within 10 min.
        within_1_h: size that is seen within an hour.
        within_1_day: size that is seen within a day.
    """

    deviation: str
    unit: str
    profile: str = ""
    within_10_min: float | None
    within_1_h: float | None
    within_1_day: float | None

    @classmethod
    def of(cls, message: messages.Power) -> Self:
        """The power of a message."""
        sizes = {name: three_digits(getattr(message, name)) if message.HasField(name) else None for name in HORIZONS}
        return cls(deviation=message.deviation, unit=message.unit, profile=message.profile, **sizes)


def state_promise(message: messages.Promise | None) -> tuple[Promise | None, list[Power]]:
    """Promise and power of a message; None and empty without one."""
    if message is None:
        return None, []
    return Promise.of(message), [Power.of(item) for item in message.power]


def three_digits(value: float) -> float:
    """Round to three significant digits."""
    return float(f"{value:.3g}")
