"""The fields of many samples at once, read from their bytes by compiled code.

A `Sample` is parsed by protobuf in half a microsecond, and each look into it costs as much again as a line of Python.
Here the bytes of all are one after the other, and one loop reads them. It knows the form that protobuf writes: known
fields, each once, in their order, without those that are zero (Protocol Buffers, encoding). What has another form is
left to protobuf itself, which alone decides what is a sample.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.codegen.numba_kernel import jit

_TIME, _SEQUENCE, _VALUE, _UNIT, _QUALITY = 0x09, 0x10, 0x19, 0x22, 0x28  # field and wire type of each
_TIME_TAG, _SEQUENCE_TAG = bytes([_TIME]), bytes([_SEQUENCE])
LONGEST_VARINT = 10
"""Bytes of the longest number that protobuf writes."""

_FNV_START, _FNV_FACTOR = np.uint64(0xCBF29CE484222325), np.uint64(0x100000001B3)


class SampleColumns(NamedTuple):
    """Of each sample a number; all are of shape (samples,).

    Attributes:
        plain: whether it has the form that is read here; what else is said of it means nothing if not.
        time_ns: of the sample.
        sequence: its number.
        value: what was measured.
        unit: a digest of its unit, see `unit_digest`.
        quality: as in the message.
    """

    plain: NDArray[np.bool_]
    time_ns: NDArray[np.int64]
    sequence: NDArray[np.int64]
    value: NDArray[np.float64]
    unit: NDArray[np.uint64]
    quality: NDArray[np.int64]


def sample_number(payload: bytes) -> int:
    """The number of one sample, read without parsing the rest; 0 where the bytes have another form."""
    at = 9 if payload[:1] == _TIME_TAG else 0  # the time takes eight bytes, and none where it is zero
    if payload[at : at + 1] != _SEQUENCE_TAG:
        return 0
    number = 0
    for place, byte in enumerate(payload[at + 1 : at + 1 + LONGEST_VARINT]):
        number |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return number
    return 0


def sample_columns(payloads: Sequence[bytes]) -> SampleColumns:
    """The fields of samples.

    Args:
        payloads: their bytes.
    """
    count = len(payloads)
    found = SampleColumns(
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
        found.plain,
        found.time_ns,
        found.time_ns.view(np.uint8),
        found.sequence,
        found.value.view(np.uint8),
        found.unit,
        found.quality,
    )
    return found


def unit_digest(unit: str) -> int:
    """What the unit of a sample is known by: the 64-bit FNV-1a hash (Fowler, Noll & Vo) of its bytes.

    >>> hex(unit_digest("a"))
    '0xaf63dc4c8601ec8c'
    """
    digest = int(_FNV_START)
    for byte in unit.encode():
        digest = ((digest ^ byte) * int(_FNV_FACTOR)) % 2**64
    return digest


@jit
def _varint(data: NDArray[np.uint8], place: int, end: int) -> tuple[int, int]:
    """A number of at most 63 bits and the place behind it; the place is -1 if there is none."""
    number, shift = 0, 0
    while place < end and shift < 63:
        byte = int(data[place])
        place += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, place
        shift += 7
    return 0, -1


@jit
def _read(
    data: NDArray[np.uint8],
    ends: NDArray[np.int64],
    plain: NDArray[np.bool_],
    time_ns: NDArray[np.int64],
    time_bytes: NDArray[np.uint8],
    sequence: NDArray[np.int64],
    value_bytes: NDArray[np.uint8],
    unit: NDArray[np.uint64],
    quality: NDArray[np.int64],
) -> None:
    place = 0
    for k in range(ends.size):
        begin, end = place, ends[k]
        place = end
        digest, last, good = _FNV_START, 0, True
        while good and begin < end:
            tag = int(data[begin])
            begin += 1
            good = tag > last
            last = tag
            if tag in (_TIME, _VALUE) and begin + 8 <= end:
                for byte in range(8):
                    if tag == _TIME:
                        time_bytes[8 * k + byte] = data[begin + byte]
                    else:
                        value_bytes[8 * k + byte] = data[begin + byte]
                begin += 8
            elif tag in (_SEQUENCE, _QUALITY, _UNIT):
                number, begin = _varint(data, begin, end)
                good = good and begin >= 0
                if tag == _SEQUENCE:
                    sequence[k] = number
                elif tag == _QUALITY:
                    quality[k] = number
                elif good and begin + number <= end:
                    for byte in range(number):
                        digest = (digest ^ np.uint64(data[begin + byte])) * _FNV_FACTOR
                    begin += number
                else:
                    good = False
            else:
                good = False
        unit[k] = digest
        plain[k] = good
