"""Promise of false alarms and power of a plant in words."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from msgspec.structs import replace

from reactorwatch.contract import messages_pb2 as messages

if TYPE_CHECKING:
    from reactorwatch.results.promise import Power

NONE_STATED = "none stated: only charts of values watch, or none within its bounds is seen"

REMEDY = "train longer, or over more set points"


def describe_promise(promise: messages.Promise, rows_in_30_days: float) -> str:
    """One sentence on a promise in 30 days, with the alarms of the training and since; of slow rows by rows as well."""
    per_rows = ""
    if rows_in_30_days < 8600.0:  # rows are slower than 5 min
        per_rows = f" (1 in {float(f'{rows_in_30_days / promise.can_keep_per_30_days:.2g}'):,g} rows)"
    checked = (
        f"in the second half of its training, judged by the first, {_count(promise.found_in_training)}, "
        f"{promise.expected_in_training:.2g} promised"
    )
    if promise.kept:
        parts = [
            f"false alarms in 30 days: {promise.expected:.2g} on average{per_rows}, at most "
            f"{promise.expected_90:.2g} for this plant with 90 % confidence",
            checked if promise.checked_rows else "the training was too short to be judged by itself",
        ]
    else:
        parts = [
            (f"{checked}: " if promise.found_in_training else "")
            + "this plant wanders, its model errs after moves of the inputs, or its training has not seen enough of"
            f" it; from this training {describe_rate(promise.can_keep_per_30_days)}{per_rows} can be promised; {REMEDY}"
        ]
    if promise.found:
        parts.append(f"{_count(promise.found)} since, {promise.expected_so_far:.2g} promised")
    if promise.drifted:
        parts.append("if nothing is wrong, the plant has drifted from its training: train it again")
    return "; ".join(parts)


def describe_broken_promise(can_keep_per_30_days: float, whose: str = "") -> str:
    """The rate of false alarms that a training shows, where the promise is not kept."""
    return f"by its training, false alarms{whose} may come {describe_rate(can_keep_per_30_days)}"


def describe_rate(per_30_days: float) -> str:
    """A rate of alarms in words.

    >>> describe_rate(1080.0), describe_rate(40.0), describe_rate(2.0), describe_rate(0.1), describe_rate(0.003)
    ('1 in 40 min', '1 in 18 h', '1 in 15 days', '1 in 300 days', '1 in 27 years')
    """
    minutes = 30 * 1440.0 / per_30_days
    for unit, size, most in (("min", 1.0, 100.0), ("h", 60.0, 100.0), ("days", 1440.0, 1000.0)):
        if minutes < most * size:
            return f"1 in {float(f'{minutes / size:.2g}'):g} {unit}"
    return f"1 in {float(f'{minutes / (365.25 * 1440.0):.2g}'):,g} years"


def describe_power(power: Sequence["Power"]) -> str:
    """Steps that are seen within an hour, else within a day, and those of which no size is stated, as one line."""
    steps = [item for item in power if not item.profile and item.within_1_h is not None]
    if not steps:
        later = [item for item in power if not item.profile and item.within_1_day is not None]
        within_1_day = [replace(item, within_1_h=item.within_1_day) for item in later]
        return f"none; within a day: {describe_power(within_1_day)}" if later else NONE_STATED
    are_causes = any(not item.deviation.endswith(".bias") for item in steps)
    untraced = "; not stated: causes with states of their own or jumps, as lags" if are_causes else ""
    units = ("" if item.unit == "1" else f" {item.unit}" for item in steps)
    sizes = (f"{item.deviation} {item.within_1_h:.2g}" for item in steps)
    return ", ".join(f"{size}{unit}" for size, unit in zip(sizes, units, strict=True)) + untraced


def describe_sizes(power: "Power") -> str:
    """Sizes of one deviation that are seen, as one line."""
    sizes = {
        "within 10 min": power.within_10_min,
        "within an hour": power.within_1_h,
        "within a day": power.within_1_day,
    }
    profile = ", ramp by its size in a day" if power.profile else ""
    seen = ", ".join(f"{'none' if size is None else f'{size:.2g}'} {end}" for end, size in sizes.items())
    return f"{power.deviation} ({power.unit}{profile}): {seen}"


def _count(alarms: int) -> str:
    return "1 alarm came" if alarms == 1 else f"{alarms or 'no'} alarms came"
