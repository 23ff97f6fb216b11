"""State of a streaming stage as one explicit structure that can be stored, without pickle.

A part's memory is one such structure (`Memory`): it is what runs, and what is stored. Many numbers of one kind are
stored as consecutive doubles (`pack_numbers`): shorter than a list of MessagePack, and much faster to read. A field may
be an array of doubles (NumPy's, or the growing one of `array`) or of records, or an object that has a `memory` of its
`memory_type` and is made from it by `resume`: it is stored as the array's numbers, with the shape of a matrix, or as
the object's memory. A message of the bus is stored as it is sent.
"""

from array import array
from typing import Any, Self, TypeAlias, TypeVar, get_args, get_origin
from zlib import crc32

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray


class Storable:
    """Mixin of structures that can be stored, as MessagePack."""

    __slots__ = ()

    def to_bytes(self) -> bytes:
        """The state as MessagePack; numbers come back bit for bit."""
        return _ENCODER.encode(self)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The state that `to_bytes` stored.

        Raises:
            ValueError: the bytes are not such a state.
        """
        try:
            return msgspec.msgpack.decode(data, type=cls, dec_hook=_decode)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"not a {cls.__name__}: {error}") from error


Stored = TypeVar("Stored", bound=Storable)

Records: TypeAlias = NDArray[np.void]
"""Array of records, as kernels change them; stored as bytes, which `place_records` puts in their place."""


class Memory(Storable, msgspec.Struct, forbid_unknown_fields=True):
    """Base class of structures that change with the rows and are their own state: their fields are what is stored."""


def copy_of(memory: Stored) -> Stored:
    """A copy of a memory that shares nothing with it, as stored and read again."""
    return type(memory).from_bytes(memory.to_bytes())


def pack_numbers(values: ArrayLike) -> bytes:
    """Write numbers as little-endian doubles, row after row."""
    return np.asarray(values, dtype="<f8").tobytes()


def unpack_numbers(data: bytes, columns: int) -> NDArray[np.float64]:
    """Read the output of `pack_numbers`, shape (rows, columns).

    Raises:
        ValueError: it is no whole number of rows.
    """
    return np.frombuffer(data, dtype="<f8").reshape(-1, columns).astype(np.float64)


def pack_records(records: NDArray[np.void]) -> bytes:
    """Write records of a structured type, with a digest of its fields.

    The padding between fields, whose bytes are arbitrary, is left out.
    """
    from numpy.lib.recfunctions import repack_fields  # 40 ms, which no command needs that stores nothing

    packed = repack_fields(records, recurse=True)
    return _digest(packed.dtype) + packed.tobytes()


def unpack_records(data: bytes, kind: np.dtype[Any], count: int) -> NDArray[np.void]:
    """Read the output of `pack_records`, shape (count,).

    Raises:
        ValueError: they are records of other fields, or another number of them.
    """
    from numpy.lib.recfunctions import repack_fields

    packed = repack_fields(kind, recurse=True)
    digest = _digest(packed)
    if not data.startswith(digest) or len(data) != len(digest) + count * packed.itemsize:
        raise ValueError(f"there must be {count} records of {packed.itemsize} bytes, got {len(data)} bytes or others")
    return np.frombuffer(data, packed, offset=len(digest)).astype(kind)


def _digest(kind: np.dtype[Any]) -> bytes:
    """Digest of the fields of a structured type: records of other fields may have the same size."""
    return crc32(repr(kind.descr).encode()).to_bytes(4, "little")


def read_memory(data: Any, kind: type[Stored]) -> Stored:
    """A memory of a kind from a field of any type, as it was read.

    Raises:
        ValueError: the data are of another kind.
    """
    try:
        return msgspec.convert(data, kind, dec_hook=_decode)
    except msgspec.ValidationError as error:
        raise ValueError(f"not a {kind.__name__}: {error}") from error


def place_records(stored: Records, into: Records) -> Records:
    """Copy records, as they were stored or as they run, into an array of as many of their type, and return that.

    Raises:
        ValueError: they are of another number or type.
    """
    if stored.dtype.names is None:
        stored = unpack_records(stored.tobytes(), into.dtype, into.size)
    if stored.dtype != into.dtype or stored.shape != into.shape:
        raise ValueError(f"there must be {into.size} records of {into.itemsize} bytes, got {stored.size} or others")
    into[:] = stored
    return into


def _encode(value: Any) -> Any:
    if isinstance(value, np.generic):  # a number of NumPy's, as an element of an array is
        return value.item()
    if isinstance(value, array):
        return value.typecode, value.tobytes()
    if hasattr(value, "SerializeToString"):
        return value.SerializeToString()
    if not isinstance(value, np.ndarray):
        return value.memory
    if value.dtype.names is not None:
        return pack_records(value)
    if value.dtype == np.uint8:  # records as they were read, which nothing has placed since
        return value.tobytes()
    return pack_numbers(value) if value.ndim == 1 else (value.shape, pack_numbers(value))


def _decode(kind: Any, data: Any) -> Any:
    if kind is array:
        typecode, numbers = data
        return array(typecode, numbers)
    if get_origin(kind) is np.ndarray:
        if get_args(kind)[1] == np.dtype[np.void]:
            return np.frombuffer(data, np.uint8)
        if isinstance(data, bytes):
            return unpack_numbers(data, 1)[:, 0]
        shape, numbers = data
        return unpack_numbers(numbers, 1).reshape(shape)
    if hasattr(kind, "FromString"):
        return kind.FromString(data)
    if not hasattr(kind, "resume"):  # a field of any type
        return data
    return kind.resume(read_memory(data, kind.memory_type))


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_encode)
