"""Promise of false alarms and power of a plant in words."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from reactorwatch.contract import messages_pb2 as messages

if TYPE_CHECKING:
    from reactorwatch.results.promise import Power

REMEDY = "train longer, or over more set points"


def describe_promise(promise: messages.Promise) -> str:
    """One sentence on a promise in 30 days, with the alarms of the training and since."""
    checked = (
        f"in the second half of its training, judged by the first, {_count(promise.found_in_training)}, "
        f"{promise.expected_in_training:.2g} promised"
    )
    if promise.kept:
        parts = [
            f"false alarms in 30 days: {promise.expected:.2g} on average, at most "
            f"{promise.expected_90:.2g} for this plant with 90 % confidence",
            checked if promise.checked_rows else "the training was too short to be judged by itself",
        ]
    else:
        parts = [
            (f"{checked}: " if promise.found_in_training else "")
            + "this plant wanders, its model errs after moves of the inputs, or its training has not seen enough of"
            f" it; from this training {describe_rate(promise.can_keep_per_30_days)} can be promised; {REMEDY}"
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

    >>> describe_rate(1080.0), describe_rate(40.0), describe_rate(2.0)
    ('1 in 40 min', '1 in 18 h', '1 in 15 days')
    """
    minutes = 30 * 1440.0 / per_30_days
    for unit, size in (("min", 1.0), ("h", 60.0)):
        if minutes < 100.0 * size:
            return f"1 in {minutes / size:.2g} {unit}"
    return f"1 in {minutes / 1440.0:.2g} days"


def describe_power(power: Sequence["Power"]) -> str:
    """Steps that are seen within an hour, and those of which no size is stated, as one line."""
    steps = [item for item in power if not item.profile and item.within_1_h is not None]
    if not steps:
        return "none stated: only charts of values watch, or none within its bounds is seen"
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
