"""Compiled parser for the fields of many samples at once.

Protobuf parses a `Sample` in half a microsecond, and each access to a field costs as much again as a line of Python.
Here one loop reads the concatenated bytes of all. It knows the canonical form: known fields, each once, in their order,
without zeros (Protocol Buffers, encoding). Bytes in another form are left to protobuf itself, which alone defines a
sample.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.codegen.numba_kernel import jit

_TIME, _SEQUENCE, _VALUE, _UNIT, _QUALITY = 0x09, 0x10, 0x19, 0x22, 0x28  # field and wire type of each
MAX_VARINT = 10
"""Bytes of protobuf's longest number."""

_FNV_START, _FNV_FACTOR = np.uint64(0xCBF29CE484222325), np.uint64(0x100000001B3)


class SampleColumns(NamedTuple):
    """Fields of samples, each of shape (samples,).

    Attributes:
        is_canonical: True for bytes in canonical form; the other fields are valid only for these.
        time_ns: time of the sample.
        sequence: sequence number.
        value: measured value.
        unit: digest of the unit, see `unit_digest`.
        quality: quality as in the message.
    """

    is_canonical: NDArray[np.bool_]
    time_ns: NDArray[np.int64]
    sequence: NDArray[np.int64]
    value: NDArray[np.float64]
    unit: NDArray[np.uint64]
    quality: NDArray[np.int64]


def read_sequence(payload: bytes) -> int:
    """Read the sequence number of one sample without parsing the rest; 0 for bytes in another form."""
    try:
        at = 9 if payload[0] == _TIME else 0  # the time takes eight bytes, or none if it is zero
        if payload[at] != _SEQUENCE:
            return 0
        byte = payload[at + 1]
        number, shift = byte & 0x7F, 7
        while byte >= 0x80 and shift < 7 * MAX_VARINT:
            byte = payload[at + 1 + shift // 7]
            number |= (byte & 0x7F) << shift
            shift += 7
    except IndexError:
        return 0
    return number if byte < 0x80 else 0


def parse_samples(payloads: Sequence[bytes]) -> SampleColumns:
    """Parse encoded samples."""
    count = len(payloads)
    columns = SampleColumns(
        np.zeros(count, np.bool_),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        np.zeros(count),
        np.zeros(count, np.uint64),
        np.zeros(count, np.int64),
    )
    ends = np.cumsum(np.fromiter(map(len, payloads), np.int64, count))
    _read(
        np.frombuffer(b"".join(payloads), np.uint8),
        ends,
        columns.is_canonical,
        columns.time_ns,
        columns.time_ns.view(np.uint8),
        columns.sequence,
        columns.value.view(np.uint8),
        columns.unit,
        columns.quality,
    )
    return columns


def unit_digest(unit: str) -> int:
    """64-bit FNV-1a hash (Fowler, Noll & Vo) of a unit's bytes.

    >>> hex(unit_digest("a"))
    '0xaf63dc4c8601ec8c'
    """
    digest = int(_FNV_START)
    for byte in unit.encode():
        digest = ((digest ^ byte) * int(_FNV_FACTOR)) % 2**64
    return digest


@jit
def _varint(data: NDArray[np.uint8], position: int, end: int) -> tuple[int, int]:
    """Read a number of at most 63 bits; returns it and the position behind it, -1 if there is none."""
    number, shift = 0, 0
    while position < end and shift < 63:
        byte = int(data[position])
        position += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, position
        shift += 7
    return 0, -1


@jit
def _read(
    data: NDArray[np.uint8],
    ends: NDArray[np.int64],
    is_canonical: NDArray[np.bool_],
    time_ns: NDArray[np.int64],
    time_bytes: NDArray[np.uint8],
    sequence: NDArray[np.int64],
    value_bytes: NDArray[np.uint8],
    unit: NDArray[np.uint64],
    quality: NDArray[np.int64],
) -> None:
    start = 0
    for k in range(ends.size):
        position, end = start, ends[k]
        start = end
        digest, last, good = _FNV_START, 0, True
        while good and position < end:
            tag = int(data[position])
            position += 1
            good = tag > last
            last = tag
            if tag in (_TIME, _VALUE) and position + 8 <= end:
                for byte in range(8):
                    if tag == _TIME:
                        time_bytes[8 * k + byte] = data[position + byte]
                    else:
                        value_bytes[8 * k + byte] = data[position + byte]
                position += 8
            elif tag in (_SEQUENCE, _QUALITY, _UNIT):
                number, position = _varint(data, position, end)
                good = good and position >= 0
                if tag == _SEQUENCE:
                    sequence[k] = number
                elif tag == _QUALITY:
                    quality[k] = number
                elif good and position + number <= end:
                    for byte in range(number):
                        digest = (digest ^ np.uint64(data[position + byte])) * _FNV_FACTOR
                    position += number
                else:
                    good = False
            else:
                good = False
        unit[k] = digest
        is_canonical[k] = good
