"""Units of measured columns, and their conversion to those of a process."""

from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_ALIASES = {"°C": "degC", "C": "degC", "Celsius": "degC", "celsius": "degC", "°F": "degF", "Kelvin": "K", "°K": "K"}
_ALIASES |= {
    "sec": "s",
    "seconds": "s",
    "l": "L",
    "liter": "L",
    "litre": "L",
    "m³": "m3",
    "cm³": "cm3",
    "ml": "mL",
    "hr": "h",
}
_ALIASES |= {"percent": "%", "pct": "%", "-": "1", "mole": "mol", "Nm³": "Nm3", "minute": "min", "hour": "h"}
_SCALES = {
    "temperature": "K 1, degC 1 273.15, degF 5/9 45967/180",
    "share": "1 1, % 0.01, ppm 1e-6",
    "pressure": "Pa 1, hPa 100, kPa 1000, MPa 1e6, mbar 100, bar 1e5, psi 6894.757293168",
    "length": "m 1, dm 0.1, cm 0.01, mm 0.001",
    "volume": "m3 1, L 0.001, dm3 0.001, cm3 1e-6, mL 1e-6",
    "mass": "kg 1, g 0.001, mg 1e-6, t 1000",
    "amount": "mol 1, mmol 0.001, kmol 1000",
    "time": "s 1, min 60, h 3600, d 86400, ms 0.001",
    "voltage": "V 1, mV 0.001, kV 1000",
    "current": "A 1, mA 0.001",
    "power": "W 1, kW 1000, MW 1e6",
}
"""Units of each quantity, each with its factor and offset to the first."""


class _Scale(NamedTuple):
    """Quantity of a unit, and the factor and offset to its base unit."""

    quantity: tuple[str, ...]
    factor: Fraction
    offset: Fraction


KNOWN: dict[str, _Scale] = {}
"""Scale of each unit."""
for _quantity, _units in _SCALES.items():
    for _unit, _factor, *_offset in map(str.split, _units.split(", ")):
        KNOWN[_unit] = _Scale((_quantity,), Fraction(_factor), Fraction(*_offset) if _offset else Fraction(0))


class UnitError(ValueError):
    """Two units of different quantities."""


def convert(values: NDArray[np.float64], unit: str, wanted: str) -> NDArray[np.float64] | None:
    """Convert values to another unit.

    Returns:
        The values in the wanted unit; None if one of the units is not known here.

    Raises:
        UnitError: both units are known, and are of different quantities.

    >>> convert(np.array([20.0]), "degC", "K").tolist()
    [293.15]
    >>> convert(np.array([6.0]), "m3/h", "l/min").tolist()
    [100.0]
    """
    if _spell(unit) == _spell(wanted):
        return values
    source, target = _resolve(unit), _resolve(wanted)
    if source is None or target is None:
        return None
    if source.quantity != target.quantity:
        raise UnitError
    ratio, shift = source.factor / target.factor, (source.offset - target.offset) / target.factor
    return values * float(ratio.numerator) / float(ratio.denominator) + float(shift)


def _spell(unit: str) -> str:
    parts = [part.strip() for part in unit.strip().split("/")]
    return "/".join(_ALIASES.get(part, part) for part in parts)


def _resolve(unit: str) -> _Scale | None:
    """Scale of a unit or of a quotient of two; None if it is not known."""
    parts = [KNOWN.get(part) for part in _spell(unit).split("/")]
    if None in parts or len(parts) > 2:
        return None
    first, *rest = (part for part in parts if part is not None)
    if not rest:
        return first
    return _Scale((*first.quantity, *rest[0].quantity), first.factor / rest[0].factor, Fraction(0))
