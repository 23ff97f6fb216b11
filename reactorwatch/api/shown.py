"""Base of results in Python: the struct that a command prints, with the record that it is of."""

from typing import Any, Generic, TypeVar

from reactorwatch.records.record import Record
from reactorwatch.results.base import Result

R = TypeVar("R", bound=Result)


class Shown(Generic[R]):
    """A result with its record, to be shown in a notebook.

    Attributes:
        result: the result, whose fields are attributes of this object, too.
        record: the record.
    """

    def __init__(self, result: R, record: Record) -> None:
        self.result, self.record = result, record

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "result":  # as of a copy that is not filled yet
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.result, name)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self.result.__struct_fields__})

    def to_dict(self) -> dict[str, Any]:
        """The object that the command prints with `--json`; numbers that are not finite are None."""
        return self.result.to_dict()
