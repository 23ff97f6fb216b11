"""Conversion of samples to the units in which a process is judged. Pure."""

from collections.abc import Mapping

from reactorwatch.units import UnknownUnitError, conversion

MOST_UNITS = 1000
"""Pairs of a signal and a unit whose conversion is kept; publishers choose the texts."""


SAME = (1.0, 0.0)
"""Conversion of a unit to itself, or to another spelling of it."""


class SampleUnits:
    """Converts the samples of a plant; those of signals without a unit here are judged in the units that they come in.

    Args:
        declared: units of the signals as their process describes them.
        model_units: units of the equations.

    Attributes:
        plain: newest unit by signal that needed no conversion.
        converted: signals whose newest sample in another unit than `plain` was converted.
    """

    def __init__(self, declared: Mapping[str, str], model_units: Mapping[str, str]) -> None:
        self._wanted, self._declared = {**declared, **model_units}, dict(declared)
        self.plain: dict[str, str] = {}
        self.converted: set[str] = set()
        self._conversions: dict[tuple[str, str], tuple[float, float]] = {}

    def convert(self, signal: str, unit: str, value: float) -> tuple[float, str]:
        """Value and unit of a sample; one in an unknown unit stays as it is.

        Args:
            signal: name of the signal.
            unit: unit that the sample names; empty: none.
            value: value in that unit.

        Raises:
            InputError: the unit measures another quantity.
        """
        value, wanted = self._convert(signal, unit, value)
        if wanted == unit:
            self.plain[signal] = unit
            self.converted.discard(signal)
        else:
            self.converted.add(signal)
        return value, wanted

    def _convert(self, signal: str, unit: str, value: float) -> tuple[float, str]:
        wanted = self._wanted.get(signal)
        if wanted is None or unit == wanted:
            return value, unit
        known = self._conversions.get((signal, unit))
        if known is None:
            known = _find_conversion(signal, unit or self._declared.get(signal, wanted), wanted)
            if len(self._conversions) < MOST_UNITS:
                self._conversions[signal, unit] = known
        scale, offset = known
        return (value, unit) if known == SAME else (scale * value + offset, wanted)


def _find_conversion(signal: str, unit: str, wanted: str) -> tuple[float, float]:
    try:
        return conversion(unit, wanted, f"sample of {signal}")
    except UnknownUnitError:
        return SAME
