"""Units convert as the international system defines them, and nothing else is computed."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reactorwatch.errors import InputError
from reactorwatch.units import conversion


def convert(value: float, unit: str, wanted: str, name: str) -> float:
    scale, offset = conversion(unit, wanted, name)
    return scale * value + offset


@pytest.mark.parametrize(
    ("value", "unit", "wanted", "expected"),
    [
        (25.0, "degC", "K", 298.15),
        (25.0, "°C", "K", 298.15),
        (212.0, "degF", "degC", 100.0),
        (60.0, "l/h", "l/min", 1.0),
        (3.6, "m3/h", "l/s", 1.0),
        (3.6, "m³/h", "l/s", 1.0),
        (1.0, "kmol/m3", "mol/l", 1.0),
        (1.0, "1", "%", 100.0),
        (60.0, "1/min", "s-1", 1.0),
        (1.0, "bar", "kPa", 100.0),
        (6.0, "m3/h", "l/min", 100.0),
        (2.0, "mmol/L", "mol/l", 0.002),
        (50.0, "%", "1", 0.5),
        (1.0, "kg/h", "g/s", 1 / 3.6),
        (7.0, "cm³/s", "cm3/sec", 7.0),
        (2.0, "Nm3/h", "m3/h", 2.0),
        (20.0, "C", "K", 293.15),
        (60.0, "V^0.5/min", "V^0.5/s", 1.0),
    ],
)
def test_a_value_converts(value: float, unit: str, wanted: str, expected: float) -> None:
    assert convert(value, unit, wanted, "x") == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("unit", ["mol/l", "foo", "", "((", "10^10^10", "2^9999", "m**", "K" * 61, "__import__('os')"])
def test_what_is_no_unit_of_the_quantity_is_refused_with_its_name(unit: str) -> None:
    with pytest.raises(InputError, match="T: unit must convert to 'K', got"):
        convert(1.0, unit, "K", "T")


@given(st.text(max_size=70))
def test_any_text_of_another_quantity_is_refused_in_one_line(unit: str) -> None:
    with pytest.raises(InputError, match=r"^T: unit must convert to 'K\^7', got "):
        convert(1.0, unit, "K^7", "T")


@pytest.mark.parametrize(
    "units",
    [
        ("K", "degC", "degF", "°C"),
        ("Pa", "hPa", "kPa", "MPa", "mbar", "bar", "psi"),
        ("m3/h", "l/min", "cm3/s", "ml/s", "dm3/d"),
        ("mol/l", "mmol/l", "kmol/m3"),
        ("1", "%", "ppm"),
        ("W", "kW", "MW", "kJ/h"),
    ],
)
def test_units_of_one_quantity_convert_there_and_back(units: tuple[str, ...]) -> None:
    for unit, other in itertools.permutations(units, 2):
        for value in (-3.5, 0.0, 27.25):
            assert convert(convert(value, unit, other, "x"), other, unit, "x") == pytest.approx(value, abs=1e-9)
