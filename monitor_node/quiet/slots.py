"""The arrays of the quiet plants: a slot for each, which the next one gets when it goes."""

from math import prod
from mmap import MAP_ANONYMOUS, MAP_PRIVATE, mmap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from monitor_node.quiet.form import QuietForm, Rest
from monitor_node.quiet.layout import Records
from monitor_node.quiet.ring import Kept, NewestRows, newest_rows, row_bytes
from monitor_node.row_step import RowNumbers
from reactorwatch.contract import keys

FIRST_ROOM = 16
"""Plants that there is room for at first; it doubles."""

NEVER_NS = 2**63 - 1


class Slots:
    """Where each plant is.

    Args:
        form: of their records.
        signals: of each plant, the input first.

    Attributes:
        of: by plant, its slot.
        names: by slot; empty where there is no plant.
        rests: by slot.
        codes: by key of a sample, the slot times the signals plus the signal.
        plants: records.
        numbers: numbers of the stages.
        times: rings of spacings, shape (slots, rows kept). It takes no memory where all are zero: whoever writes there
            leaves out what is there already.
        ring: rings of values, shape (slots, rows kept, bytes).
        others: rings of inputs at no level, shape (slots, rows kept); it takes no memory either where there are none.
        health_due_ns: by slot; never for one without a plant.
    """

    def __init__(self, form: QuietForm, signals: tuple[str, ...]) -> None:
        self._form, self._signals = form, signals
        self.of: dict[str, int] = {}
        self.names: list[str] = []
        self.rests: list[Rest | None] = []
        self._free: list[int] = []
        self.codes: dict[str, int] = {}
        self._used: NDArray[np.int64] | None = None
        self.plants: Records
        self.numbers: RowNumbers
        self.times: NDArray[np.int32]
        self.ring: NDArray[np.uint8]
        self.others: NDArray[np.int64]
        self.health_due_ns: NDArray[np.int64] = np.empty(0, np.int64)
        self._room(FIRST_ROOM)

    def take(self, plant: str) -> int:
        """A slot for a plant that comes."""
        if self._free:
            slot = self._free.pop()
            self.names[slot] = plant
        else:
            slot = len(self.names)
            if slot == len(self.plants):
                self._room(2 * slot)
            self.names.append(plant)
            self.rests.append(None)
        self.of[plant], self._used = slot, None
        for place, signal in enumerate(self._signals):
            self.codes[keys.key(plant, keys.SAMPLE, signal)] = slot * len(self._signals) + place
        return slot

    def leave(self, plant: str) -> None:
        """A plant goes, and its slot is free."""
        slot, self._used = self.of.pop(plant), None
        self.health_due_ns[slot] = NEVER_NS
        for signal in self._signals:
            del self.codes[keys.key(plant, keys.SAMPLE, signal)]
        self.plants[slot] = np.zeros(1, self._form.record)[0]
        self.rests[slot], self.names[slot] = None, ""
        self._free.append(slot)

    @property
    def used(self) -> NDArray[np.int64]:
        """The slots that have a plant."""
        if self._used is None:
            self._used = np.array(sorted(self.of.values()), dtype=np.int64)
        return self._used

    def keep(self, slot: int, spacings: NDArray[np.int32], kept: Kept) -> None:
        """Fill the beginning of the rings of a plant that comes, and what its record says of them."""
        p, count = self.plants[slot], spacings.size
        p["kept"], p["head"] = count, count % self._form.keeps
        p["levels"], p["level_rows"] = kept.levels, kept.level_rows
        p["reference"][: kept.reference.size] = kept.reference
        self.ring[slot, :count] = kept.rows
        _write(self.times[slot, :count], spacings)
        _write(self.others[slot, : kept.others.size], kept.others)

    def copy(self, of: int, slot: int) -> None:
        """Fill record and rings of a plant with those of another."""
        self.plants[slot], self.ring[slot] = self.plants[of], self.ring[of]
        for numbers in self.numbers:
            numbers[slot] = numbers[of]
        self.health_due_ns[slot] = self.health_due_ns[of]
        _write(self.times[slot], self.times[of])
        _write(self.others[slot], self.others[of])

    def rest(self, slot: int) -> Rest:
        """What is kept beside the record of a plant."""
        rest = self.rests[slot]
        assert rest is not None
        return rest

    def newest(self, slot: int) -> NewestRows:
        """The newest rows of a plant."""
        last_ns = int(self.numbers.timing["last_ns"][slot])
        return newest_rows(self.plants[slot], last_ns, self.times[slot], self.ring[slot], self.others[slot])

    def numbers_of(self, slot: int) -> RowNumbers:
        """Numbers of the stages of one plant."""
        return RowNumbers(*(numbers[slot] for numbers in self.numbers))

    def _room(self, plants: int) -> None:
        """Make room for so many."""
        form, before = self._form, len(self.names)
        records, times = _zeros((plants,), form.record), _zeros((plants, form.keeps), np.dtype(np.int32))
        ring = _zeros((plants, form.keeps, row_bytes(form.columns)), np.dtype(np.uint8))
        others = _zeros((plants, form.keeps if form.columns else 0), np.dtype(np.int64))
        numbers = form.step.shape(plants, _zeros)
        if before:
            records[:before], ring[:before] = self.plants, self.ring
            for larger, smaller in zip(numbers, self.numbers, strict=True):
                larger[:before] = smaller
            for now, then in ((times, self.times), (others, self.others)):
                written = np.flatnonzero(then.any(axis=1))
                now[written] = then[written]
        self.plants, self.times, self.ring, self.others = records, times, ring, others
        self.numbers = numbers
        due_ns = np.full(plants, NEVER_NS)
        due_ns[:before] = self.health_due_ns[:before]
        self.health_due_ns = due_ns


def _write(into: NDArray[Any], values: NDArray[Any]) -> None:
    """Write what is not there already: what was never written takes no memory."""
    place = np.flatnonzero(into != values)
    into[place] = values[place]


def _zeros(shape: tuple[int, ...], kind: np.dtype[Any]) -> NDArray[Any]:
    """An array of zeros, straight from the system: it keeps no memory of what was never written, nor of what was."""
    count = prod(shape)
    memory = mmap(-1, max(count, 1) * kind.itemsize, flags=MAP_PRIVATE | MAP_ANONYMOUS)  # if shared, to read takes some
    return np.frombuffer(memory, kind, count).reshape(shape)
