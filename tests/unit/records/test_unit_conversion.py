"""Units of measured columns: conversion there and back, aliases, and quantities that do not convert."""

import itertools

import numpy as np
import pytest

from reactorwatch.records.units import KNOWN, UnitError, convert

VALUES = np.array([-3.5, 0.0, 1.0, 27.25])
PAIRS = list(itertools.permutations(KNOWN, 2))


def test_each_pair_of_units_converts_there_and_back_or_is_of_two_quantities() -> None:
    for unit, other in PAIRS:
        if KNOWN[unit].quantity != KNOWN[other].quantity:
            with pytest.raises(UnitError):
                convert(VALUES, unit, other)
            continue
        there = convert(VALUES, unit, other)
        assert there is not None
        back = convert(there, other, unit)
        assert back is not None
        np.testing.assert_allclose(back, VALUES, rtol=1e-12, atol=1e-12, err_msg=f"{unit} {other}")


@pytest.mark.parametrize(
    ("value", "unit", "wanted", "converted"),
    [
        (25.0, "°C", "K", 298.15),
        (212.0, "degF", "degC", 100.0),
        (6.0, "m3/h", "l/min", 100.0),
        (2.0, "mmol/L", "mol/l", 0.002),
        (50.0, "%", "1", 0.5),
        (1.0, "bar", "kPa", 100.0),
        (1.0, "kg/h", "g/s", 1 / 3.6),
        (7.0, "cm³/s", "cm3/sec", 7.0),
    ],
)
def test_units_convert_as_tables_say(value: float, unit: str, wanted: str, converted: float) -> None:
    found = convert(np.array([value]), unit, wanted)
    assert found is not None
    assert found[0] == pytest.approx(converted, rel=1e-12)


def test_a_unit_that_is_not_known_is_left_to_the_caller() -> None:
    assert convert(VALUES, "pH", "K") is None
    assert convert(VALUES, "furlong/fortnight", "m/s") is None
    assert convert(VALUES, "pH", "pH") is VALUES
