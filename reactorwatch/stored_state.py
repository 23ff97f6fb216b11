"""What a streaming part remembers, in a form that can be stored: one explicit structure, no pickle.

Many numbers of one kind are stored as doubles one after the other (`packed`): shorter than a list of MessagePack, and
much faster to read.
"""

from collections.abc import Iterable
from typing import Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray


class StoredState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the states; a subclass lists what there is to remember."""

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


def packed(values: ArrayLike) -> bytes:
    """Little-endian doubles, row after row."""
    return np.asarray(values, dtype="<f8").tobytes()


def unpacked(data: bytes, columns: int) -> NDArray[np.float64]:
    """What `packed` stored, shape (rows, columns).

    Raises:
        ValueError: it is no whole number of rows.
    """
    return np.frombuffer(data, dtype="<f8").reshape(-1, columns).astype(np.float64)


def packed_times(times_ns: Iterable[int]) -> bytes:
    """Little-endian integers of 64 bits."""
    return np.fromiter(times_ns, dtype="<i8").tobytes()


def unpacked_times(data: bytes) -> list[int]:
    """What `packed_times` stored.

    Raises:
        ValueError: it is no whole number of times.
    """
    times: list[int] = np.frombuffer(data, dtype="<i8").tolist()
    return times
