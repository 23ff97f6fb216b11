"""The wheel marks each of its packages as typed, so that mypy of its users sees the types."""

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WHEEL = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]["targets"][
    "wheel"
]


@pytest.mark.parametrize("package", WHEEL["packages"])
def test_a_package_of_the_wheel_is_marked_as_typed(package: str) -> None:
    assert (ROOT / package / "__init__.py").is_file()
    assert (ROOT / package / "py.typed").read_bytes() == b""
