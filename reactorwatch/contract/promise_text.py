"""Promise of false alarms and power of a plant, as commands show them."""

from collections.abc import Sequence
from typing import Any

from reactorwatch.contract.messages_pb2 import Power, Promise

HORIZONS = ("within_10_min", "within_1_h", "within_1_day")


def promise_fields(promise: Promise | None) -> dict[str, Any]:
    """Fields `promise`, per 30 days, and `power` of the objects that commands print; null and empty without one."""
    if promise is None:
        return {"promise": None, "power": []}
    stated = {
        name: _three_digits(value) if isinstance(value, float) else value
        for name in Promise.DESCRIPTOR.fields_by_name
        if name not in ("time_ns", "power")
        for value in [getattr(promise, name)]
    }
    return {"promise": stated, "power": [_power(item) for item in promise.power]}


def _power(power: Power) -> dict[str, Any]:
    """Sizes of a deviation that are seen, by horizon; null: none."""
    profile = {"profile": power.profile} if power.profile else {}
    sizes = {name: _three_digits(getattr(power, name)) if power.HasField(name) else None for name in HORIZONS}
    return {"deviation": power.deviation, "unit": power.unit, **profile, **sizes}


def describe_power(power: Sequence[dict[str, Any]]) -> str:
    """Steps that are seen within an hour, and those of which no size is stated, as one line.

    >>> describe_power([{"deviation": "T.bias", "unit": "K", "within_1_h": 0.21}])
    'T.bias 0.21 K'
    >>> describe_power([{"deviation": "T.bias", "unit": "K", "within_1_h": None}])
    'none stated: only charts of values watch, or none within its bounds is seen'
    """
    steps = [item for item in power if not item.get("profile") and item["within_1_h"] is not None]
    if not steps:
        return "none stated: only charts of values watch, or none within its bounds is seen"
    are_causes = any(not item["deviation"].endswith(".bias") for item in steps)
    untraced = "; not stated: causes with states of their own or jumps, as lags" if are_causes else ""
    units = ("" if item["unit"] == "1" else f" {item['unit']}" for item in steps)
    sizes = (f"{item['deviation']} {item['within_1_h']:.2g}" for item in steps)
    return ", ".join(f"{size}{unit}" for size, unit in zip(sizes, units, strict=True)) + untraced


def describe_sizes(power: dict[str, Any]) -> str:
    """Sizes of one deviation that are seen, as one line.

    >>> sizes = {"within_10_min": None, "within_1_h": 0.21, "within_1_day": 0.1}
    >>> describe_sizes({"deviation": "T.bias", "unit": "K", **sizes})
    'T.bias (K): none within 10 min, 0.21 within an hour, 0.1 within a day'
    """
    ends = ("within 10 min", "within an hour", "within a day")
    sizes = ("none" if power[name] is None else f"{power[name]:.2g}" for name in HORIZONS)
    profile = ", ramp by its size in a day" if power.get("profile") else ""
    seen = ", ".join(f"{size} {end}" for size, end in zip(sizes, ends, strict=True))
    return f"{power['deviation']} ({power['unit']}{profile}): {seen}"


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")
