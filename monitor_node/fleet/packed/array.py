"""Arrays of the packed plants: one slot a plant; a free slot is used again."""

from math import prod
from mmap import MAP_ANONYMOUS, MAP_PRIVATE, mmap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from monitor_node.fleet.packed.conversion import Conversion, Rest
from monitor_node.fleet.packed.record import Records
from monitor_node.fleet.packed.ring import NewestRows, keep_rows, newest_rows, row_bytes
from monitor_node.pipeline.row_step import FilterNumbers
from reactorwatch.contract import keys
from reactorwatch.records.record import NEVER_NS

FIRST_ROOM = 16
"""Number of slots at first; it doubles."""


class PlantArray:
    """Slots of plants, and their arrays.

    Args:
        form: conversion to and from monitors.
        signals: names of each plant's signals, the inputs first.

    Attributes:
        of: slot by plant.
        names: plant by slot; empty for a free slot.
        rests: state beside the numbers, by slot.
        codes: slot times the number of signals plus the index of the signal, by key of a sample.
        plants: records.
        numbers: numbers of the stages.
        kalman: numbers of the filters.
        times: rings of spacings, shape (slots, rows kept). They take no memory where all are zero: unchanged values are
            not written.
        ring: rings of values, shape (slots, rows kept, bytes).
        others: rings of inputs at no level, shape (slots, rows kept, inputs); they take no memory where there are none.
        health_due_ns: time of the next health message, by slot; never for a free slot.
    """

    def __init__(self, form: Conversion, signals: tuple[str, ...]) -> None:
        self._form, self._signals = form, signals
        self.of: dict[str, int] = {}
        self.names: list[str] = []
        self.rests: list[Rest | None] = []
        self._free: list[int] = []
        self.codes: dict[str, int] = {}
        self._occupied: NDArray[np.int64] | None = None
        self.plants: Records
        self.numbers: Records
        self.kalman: FilterNumbers
        self.times: NDArray[np.int32]
        self.ring: NDArray[np.uint8]
        self.others: NDArray[np.int64]
        self.health_due_ns: NDArray[np.int64] = np.empty(0, np.int64)
        self._room(FIRST_ROOM)

    def take(self, plant: str) -> int:
        """Take a slot for a plant."""
        if self._free:
            slot = self._free.pop()
            self.names[slot] = plant
        else:
            slot = len(self.names)
            if slot == len(self.plants):
                self._room(2 * slot)
            self.names.append(plant)
            self.rests.append(None)
        self.of[plant], self._occupied = slot, None
        for place, signal in enumerate(self._signals):
            self.codes[keys.key(plant, keys.SAMPLE, signal)] = slot * len(self._signals) + place
        return slot

    def leave(self, plant: str) -> None:
        """Free the slot of a plant."""
        slot, self._occupied = self.of.pop(plant), None
        self.health_due_ns[slot] = NEVER_NS
        for signal in self._signals:
            del self.codes[keys.key(plant, keys.SAMPLE, signal)]
        self.plants[slot] = np.zeros(1, self._form.record)[0]
        self.rests[slot], self.names[slot] = None, ""
        self._free.append(slot)

    @property
    def occupied_slots(self) -> NDArray[np.int64]:
        """Slots that have a plant."""
        if self._occupied is None:
            self._occupied = np.array(sorted(self.of.values()), dtype=np.int64)
        return self._occupied

    def keep(self, slot: int, rows: NewestRows, usual_ns: int) -> bool:
        """Fill the rings of a new plant; returns False if they cannot keep its rows, see `keep_rows`."""
        return keep_rows(self.plants, slot, self.times[slot], self.ring[slot], self.others[slot], rows, usual_ns)

    def rest(self, slot: int) -> Rest:
        """State of a plant beside its numbers."""
        rest = self.rests[slot]
        assert rest is not None
        return rest

    def newest(self, slot: int) -> NewestRows:
        """Newest rows of a plant."""
        last_ns = int(self.numbers["last_ns"][slot])
        return newest_rows(self.plants[slot], last_ns, self.times[slot], self.ring[slot], self.others[slot])

    def _room(self, plants: int) -> None:
        """Make slots for a number of plants."""
        form, before = self._form, len(self.names)
        records, times = _zeros((plants,), form.record), _zeros((plants, form.keeps), np.dtype(np.int32))
        ring = _zeros((plants, form.keeps, row_bytes(form.columns, form.inputs)), np.dtype(np.uint8))
        others = _zeros((plants, form.keeps if form.columns else 0, form.inputs), np.dtype(np.int64))
        numbers, f8 = _zeros((plants,), form.step.numbers_type), np.dtype(np.float64)
        belief, variances = (_zeros((plants, size), f8) for size in form.step.filter_sizes)
        if before:
            records[:before], ring[:before] = self.plants, self.ring
            numbers[:before], belief[:before] = self.numbers, self.kalman.belief
            variances[:before] = self.kalman.variances
            for now, then in ((times, self.times), (others, self.others)):
                written = np.flatnonzero(then.reshape(before, -1).any(axis=1))
                now[written] = then[written]
        self.plants, self.times, self.ring, self.others = records, times, ring, others
        self.numbers, self.kalman = numbers, FilterNumbers(belief, variances)
        due_ns = np.full(plants, NEVER_NS)
        due_ns[:before] = self.health_due_ns[:before]
        self.health_due_ns = due_ns


def _zeros(shape: tuple[int, ...], kind: np.dtype[Any]) -> NDArray[Any]:
    """Make an array of zeros in memory of the system: pages take memory when they are first written."""
    count = prod(shape)
    memory = mmap(-1, max(count, 1) * kind.itemsize, flags=MAP_PRIVATE | MAP_ANONYMOUS)  # if shared, to read takes some
    return np.frombuffer(memory, kind, count).reshape(shape)
