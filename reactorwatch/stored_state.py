"""State of a streaming stage as one explicit structure that can be stored, without pickle.

Many numbers of one kind are stored as consecutive doubles (`pack_numbers`): shorter than a list of MessagePack, and
much faster to read.
"""

from collections.abc import Iterable
from typing import Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray


class Storable:
    """Mixin of structures that can be stored, as MessagePack."""

    __slots__ = ()

    def to_bytes(self) -> bytes:
        """The state as MessagePack; numbers come back bit for bit."""
        return msgspec.msgpack.encode(self)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The state that `to_bytes` stored.

        Raises:
            ValueError: the bytes are not such a state.
        """
        try:
            return msgspec.msgpack.decode(data, type=cls)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"not a {cls.__name__}: {error}") from error


class Memory(Storable, msgspec.Struct, forbid_unknown_fields=True):
    """Base class of structures that change with the rows and are their own state: their fields are what is stored."""


class StoredState(Storable, msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base class of the states of what keeps its memory in another form; a subclass lists the fields."""


def pack_numbers(values: ArrayLike) -> bytes:
    """Write numbers as little-endian doubles, row after row."""
    return np.asarray(values, dtype="<f8").tobytes()


def unpack_numbers(data: bytes, columns: int) -> NDArray[np.float64]:
    """Read the output of `pack_numbers`, shape (rows, columns).

    Raises:
        ValueError: it is no whole number of rows.
    """
    return np.frombuffer(data, dtype="<f8").reshape(-1, columns).astype(np.float64)


def pack_times(times_ns: Iterable[int]) -> bytes:
    """Write times as little-endian integers of 64 bits."""
    return np.fromiter(times_ns, dtype="<i8").tobytes()


def unpack_times(data: bytes) -> list[int]:
    """Read the output of `pack_times`.

    Raises:
        ValueError: it is no whole number of times.
    """
    times: list[int] = np.frombuffer(data, dtype="<i8").tolist()
    return times
