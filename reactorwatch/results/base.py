"""Base of results: one struct is the JSON of a command, the attributes in Python, and the source of all sentences."""

from collections.abc import Iterator, Mapping
from math import isfinite
from typing import Any, ClassVar

import msgspec


class Result(msgspec.Struct, frozen=True, omit_defaults=True):
    """Base of results. The JSON has the fields in their order, but for those at their defaults.

    A result can be read as a mapping, too, as a part that is a dict in the JSON: `result.promise["kept"]`.

    Attributes:
        python_only: names of the fields that the JSON does not have, such as arrays for figures.
    """

    python_only: ClassVar[tuple[str, ...]] = ()

    def __getitem__(self, name: str) -> Any:
        """Value of a field by its name in the JSON."""
        for item in msgspec.structs.fields(self):
            if name == item.encode_name:
                return getattr(self, item.name)
        raise KeyError(name)

    def keys(self) -> list[str]:
        """Names of the fields in the JSON."""
        return [item.encode_name for item in msgspec.structs.fields(self) if item.name not in self.python_only]

    def values(self) -> list[Any]:
        """Values of these fields."""
        return [self[name] for name in self]

    def items(self) -> list[tuple[str, Any]]:
        """Names and values of these fields."""
        return [(name, self[name]) for name in self]

    def get(self, name: str, default: Any = None) -> Any:
        """Value of one of these fields; `default` for another name."""
        return self[name] if name in self.keys() else default

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def __len__(self) -> int:
        return len(self.keys())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in self.items())})"

    def to_dict(self, *also: str) -> dict[str, Any]:
        """The result as the JSON has it; numbers that are not finite are None.

        Args:
            also: names of fields of `python_only` that are included.
        """
        result = {}
        for item in msgspec.structs.fields(self):
            value = getattr(self, item.name)
            if item.name in self.python_only:
                if item.name in also:
                    result[item.encode_name] = _plain(value)
            elif item.required or value != _default(item):
                result[item.encode_name] = _plain(value)
        return result


Mapping.register(Result)  # so that `pandas.DataFrame(result.power)` has its columns


def _default(item: msgspec.structs.FieldInfo) -> Any:
    return item.default_factory() if item.default is msgspec.NODEFAULT else item.default


def _plain(value: Any) -> Any:
    """Convert to what JSON has."""
    if isinstance(value, Result):
        return value.to_dict()
    if isinstance(value, float):
        return float(value) if isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value
