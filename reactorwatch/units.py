"""Conversion of units.

The definitions are Pint's. Its registry takes a third of a second to load, so it is loaded when two units first differ.
"""

import re
from functools import cache
from tokenize import TokenError
from typing import Any

from reactorwatch.errors import InputError

LONGEST_UNIT = 60  # letters: twice those of any unit in use

_SPELLINGS = {"1": "dimensionless", "-": "dimensionless", "": "dimensionless"}

_NAMES = {"C": "degC", "°C": "degC", "Celsius": "degC", "°F": "degF", "°K": "K", "Kelvin": "K", "pct": "percent"}
"""Names that are written in headers, and what they mean to an engineer: Pint's C is the coulomb."""

_NORMAL_VOLUME = re.compile(r"\bNm(?=3|³|\^3)")

_MAYBE_OFFSET = re.compile(r"deg|°|^C$|celsius|fahrenheit|reaumur", re.IGNORECASE)
"""Units that may be temperatures with a zero of their own; no other needs Pint."""

_NAME = re.compile(r"°?[^\W\d]+")

_POWER = re.compile(r"(?<=[A-Za-z])(-?\d+)(?![A-Za-z\d])")
"""The power in "cm3", "m2" or "s-1"."""

_FORM = re.compile(r"(1\s*(?=/))?([^\W\d]+|[%°*/·(). ]|(\^|\*\*)-?\d{1,2}(\.\d{1,2})?(?!\s*(\^|\*\*|\d)))*")
"""Names, products, quotients and powers of up to two digits: Pint would compute any number that it is given."""


class UnknownUnitError(InputError):
    """A text that is no unit."""


def conversion(unit: str, wanted: str, name: str) -> tuple[float, float]:
    """Scale and offset that convert values from one unit to another: `scale * value + offset`.

    >>> conversion("degC", "K", "T")
    (1.0, 273.15)

    Args:
        unit: unit of the values.
        wanted: unit of the result.
        name: name of the quantity, for the message.

    Raises:
        UnknownUnitError: a unit is unknown.
        InputError: the units measure different quantities.
    """
    if unit == wanted:
        return 1.0, 0.0
    import pint

    units = _registry()
    try:
        source, target = _parse(unit), _parse(wanted)
        offset, one = (float(units.Quantity(value, source).to(target).magnitude) for value in (0.0, 1.0))
    except pint.DimensionalityError as error:
        raise InputError(f"{name}: unit must convert to {wanted!r}, got {unit!r}") from error
    except (pint.PintError, TokenError, SyntaxError, AssertionError, ArithmeticError, TypeError, ValueError) as error:
        why = str(error) or "it is no unit"
        raise UnknownUnitError(f"{name}: unit must convert to {wanted!r}, got {unit!r}: {why}") from error
    return one - offset, offset


def absolute(value: float, unit: str) -> float | None:
    """A value counted from absolute zero, in steps of its unit; None if the unit's zero is the absolute one.

    >>> absolute(20.0, "degC"), absolute(20.0, "K"), absolute(20.0, "K/min")
    (293.15, None, None)
    """
    if not _MAYBE_OFFSET.search(unit):
        return None
    try:
        scale, offset = conversion(unit, "K", unit)
    except InputError:  # another quantity
        return None
    return value + offset / scale if offset else None


def is_unit(text: str) -> bool:
    """True if a text is a unit.

    >>> is_unit("l/min"), is_unit("pipe")
    (True, False)
    """
    try:
        _parse(text)
    except (ValueError, AttributeError, TypeError, AssertionError, ArithmeticError, SyntaxError, TokenError):
        return False
    return True


def _parse(unit: str) -> Any:
    """Unit in the registry; powers may be written without a sign for them."""
    text = _SPELLINGS.get(unit.strip(), _POWER.sub(r"^\1", _NORMAL_VOLUME.sub("m", unit.strip())))
    text = _NAME.sub(lambda match: _NAMES.get(match[0], match[0]), text)
    if len(text) > LONGEST_UNIT or not _FORM.fullmatch(text):
        raise ValueError(
            f"it must be names of units with '*', '/' and powers, such as 'kJ/(mol K)', at most {LONGEST_UNIT} letters"
        )
    return _registry().Unit(text)


@cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry(autoconvert_offset_to_baseunit=True)
