"""The newest rows of a quiet plant take less room than their numbers, and lose no bit."""

from typing import NamedTuple

import numpy as np
import pytest

from monitor_node.fleet.packed.record import LEVELS, Array, Bytes, Ints, Places, Records, record_type
from monitor_node.fleet.packed.ring import NewestRows, keep_rows, newest_rows, row_bytes

TYPICAL = np.array([100.0, 0.1, 440.0])
PERIOD_NS = 6_000_000_000


class Ring(NamedTuple):
    """Ring of a plant, and its record."""

    plants: Records
    times: Places
    values: Bytes
    others: Ints

    def rows(self, last_ns: int) -> NewestRows:
        return newest_rows(self.plants[0], last_ns, *self[1:])


def times_of(count: int) -> list[int]:
    return [PERIOD_NS * k + k * k % 7 * 1000 for k in range(count)]


def keep(values: Array, inputs: int, keeps: int | None = None) -> Ring | None:
    """A ring with rows, which has room for as many or for the newest; None if they do not fit."""
    count, columns = values.shape
    room = count if keeps is None else keeps
    ring = Ring(
        np.zeros(1, record_type(inputs, max(columns - inputs, 1), 2)),
        np.zeros(room, np.int32),
        np.zeros((room, row_bytes(columns, inputs)), np.uint8),
        np.zeros((room if columns else 0, inputs), np.int64),
    )
    rows = NewestRows(times_of(count), values)
    return ring if keep_rows(ring.plants, 0, *ring[1:], rows, PERIOD_NS) else None


def assert_kept(values: Array, inputs: int, keeps: int | None = None) -> Ring:
    ring, times_ns = keep(values, inputs, keeps), times_of(len(values))
    assert ring is not None
    rows = ring.rows(times_ns[-1])
    assert rows.times_ns == times_ns[-(keeps or len(values)) :]
    assert rows.values.tobytes() == np.ascontiguousarray(values[-(keeps or len(values)) :]).tobytes()
    return ring


@pytest.mark.parametrize(("inputs", "size"), [(1, 15), (2, 9)])
def test_values_come_back_to_the_last_bit(inputs: int, size: int) -> None:
    generator = np.random.default_rng(1)
    values = TYPICAL * 10.0 ** generator.uniform(-2, 2, (2000, 3))
    values[-1] = TYPICAL
    assert assert_kept(values, inputs).values.shape == (2000, size)


def test_the_newest_rows_replace_the_oldest() -> None:
    generator = np.random.default_rng(3)
    inputs = np.repeat(generator.uniform(80, 120, 30), 10)
    assert_kept(np.column_stack([inputs, generator.uniform(400, 450, 300)]), 1, keeps=70)


def test_zero_comes_back_whatever_else_a_signal_is() -> None:
    assert_kept(np.array([[0.0, 0.1, 0.0], [100.0, 0.0, 0.0]]), 1)


@pytest.mark.parametrize("other", [-100.0, 1e-3, 1e5, -0.0, 5e-324])
def test_measured_values_of_another_sign_or_size_do_not_fit(other: float) -> None:
    assert keep(np.array([[1.0, other], [1.0, 100.0]]), 1) is None


@pytest.mark.parametrize("other", [-100.0, 1e-3, 1e5, -0.0, 5e-324])
def test_an_input_may_be_any_number(other: float) -> None:
    assert_kept(np.array([[other, 1.0], [100.0, 1.0]]), 1)


def test_an_input_that_is_held_takes_a_byte_a_row_and_nothing_else() -> None:
    inputs = np.repeat(np.random.default_rng(2).uniform(80, 120, LEVELS), 10)
    ring = assert_kept(np.column_stack([inputs, inputs[::-1], inputs]), 2)
    assert ring.values.shape == (10 * LEVELS, 9)
    assert not ring.others.any()
    assert ring.plants["level_rows"].tolist() == [[[10] * LEVELS] * 2]


def test_rows_without_values_are_kept() -> None:
    ring = keep(np.empty((5, 0)), 1)
    assert ring is not None
    assert ring.rows(times_of(5)[-1]).times_ns == times_of(5)
