"""Memories and records come back from their bytes, or are refused."""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.stored_state import Memory, Records, copy_of, pack_records, place_records, unpack_records

RECORD = np.dtype(
    [("count", "i2"), ("mean", "f8"), ("rule", np.dtype([("recent", "i1"), ("limit", "f8")], align=True))], align=True
)
OTHER = np.dtype(
    [("count", "i2"), ("mean", "f8"), ("rule", np.dtype([("recent", "i1"), ("scale", "f8")], align=True))], align=True
)


class Averages(Memory):
    mean: Array
    covariance: Array


def test_arrays_come_back_with_their_shape_and_bits() -> None:
    memory = Averages(np.array([0.1, np.nan, -0.0]), np.array([[1.0, 0.2, 0.3], [0.2, 2.0, np.inf]]))
    copy = copy_of(memory)
    np.testing.assert_array_equal(copy.mean.view("i8"), memory.mean.view("i8"))
    np.testing.assert_array_equal(copy.covariance, memory.covariance)
    copy.mean[0] = 1.0
    assert memory.mean[0] == 0.1


class Counts(Memory):
    numbers: Records


def test_records_in_a_memory_come_back_from_a_copy_of_a_copy() -> None:
    records = np.zeros(2, RECORD)
    records["count"], records["rule"]["limit"] = [3, 4], [0.5, 6.0]
    placed = place_records(copy_of(copy_of(Counts(records))).numbers, np.zeros(2, RECORD))
    np.testing.assert_array_equal(placed, records)
    np.testing.assert_array_equal(place_records(records, np.zeros(2, RECORD)), records)
    with pytest.raises(ValueError, match="there must be 2 records"):
        place_records(records[:1], np.zeros(2, RECORD))


def test_records_come_back_whatever_is_in_their_padding() -> None:
    records = np.frombuffer(bytes(range(RECORD.itemsize)) * 2, RECORD).copy()
    clean = np.zeros(2, RECORD)
    for name in RECORD.names or ():
        clean[name] = records[name]
    assert pack_records(records) == pack_records(clean)
    np.testing.assert_array_equal(unpack_records(pack_records(records), RECORD, 2), clean)


def test_records_of_other_fields_or_another_number_are_refused() -> None:
    assert RECORD.itemsize == OTHER.itemsize
    data = pack_records(np.zeros(2, RECORD))
    with pytest.raises(ValueError, match="there must be 2 records"):
        unpack_records(data, OTHER, 2)
    with pytest.raises(ValueError, match="there must be 3 records"):
        unpack_records(data, RECORD, 3)
