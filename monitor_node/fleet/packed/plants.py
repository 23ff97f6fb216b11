"""Packed plants, as a fleet uses them: plants are added and removed, samples are processed, publications returned."""

from dataclasses import fields
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from monitor_node.baseline.process_reference import ProcessReference
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet.packed.array import PlantArray
from monitor_node.fleet.packed.conversion import Conversion
from monitor_node.fleet.packed.ring import NewestRows
from monitor_node.fleet.packed.rows import NEW_MINUTE, step_rows
from monitor_node.fleet.packed.samples import find_deadlines, take_samples
from monitor_node.health.message import NODE, complete_health
from monitor_node.ingest.alignment import Counts, Row
from monitor_node.ingest.receive_stats import STALL_NS, ReceiveStats
from monitor_node.ingest.sample_limits import LARGEST_SAMPLE, USABLE
from monitor_node.pipeline.row_frame import words_of
from monitor_node.state.monitor_state import MonitorState, learning_settings, seal_state
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encoding_of
from reactorwatch.contract.messages_pb2 import AlarmKpis, Health, Sample
from reactorwatch.contract.sample_bytes import SampleColumns, parse_samples
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS, NEVER_NS

MOST_HEALTHS = 20
"""Health messages at a time, so that samples need not wait for thousands."""

LOOK_AGAIN_NS = 250_000_000
"""Longest time between two searches for plants without data; samples since may have made deadlines earlier."""

_SAMPLE = encoding_of(Sample)


class PackedPlants:
    """Monitors plants in their normal state.

    Args:
        form: conversion to and from monitors.
        config: settings of the plants' monitors.
        model: process model of the plants.
    """

    def __init__(self, form: Conversion, config: MonitorConfig, model: ProcessModel) -> None:
        self._form, self._config, self._model = form, config, model
        self._settings = learning_settings(config, model, points=False)
        self._signals = config.signals
        self._slots = PlantArray(form, self._signals)
        self._scratch = np.zeros(1, form.record)
        self._shared: dict[Any, Any] = {}  # parts of `Rest`, which are equal for many plants, are kept once
        self._overdue_ns, self._looked_ns = NEVER_NS, 0  # when the first was overdue, and when that was seen

    def __contains__(self, plant: str) -> bool:
        return plant in self._slots.of

    def __len__(self) -> int:
        return len(self._slots.of)

    @property
    def plants(self) -> list[str]:
        """Names of the packed plants."""
        return list(self._slots.of)

    def prepare(self) -> None:
        """Compile the machine code of the first use, before there are plants: on a new machine that takes seconds."""
        nobody, now = np.array([-1], np.int32), np.zeros(1, np.int64)
        rows, _ = self._align(nobody, parse_samples([b""]), now, 0)
        self._step_rows(rows, [])
        self._silent_from_ns()
        self._slots.keep(0, NewestRows([], np.empty((0, self._form.columns))), 0)

    # --- coming and going ------------------------------------------------------------------------------------

    def take(self, plant: str, monitor: Monitor) -> bool:
        """Pack a plant, if it is in its normal state; returns True if it is.

        Args:
            plant: name of the plant.
            monitor: monitor of the plant; not to be used afterwards if the plant was packed.
        """
        found = self._form.demote(monitor, self._scratch)
        if found is None:
            return False
        rest, rows = found
        usual_ns = round(float(monitor.pipeline.numbers[0]["period_ns"][0]))
        slot = self._slots.take(plant)
        self._slots.plants[slot] = self._scratch[0]
        if not self._slots.keep(slot, rows, usual_ns):
            self._slots.leave(plant)
            return False
        numbers, kalman = monitor.pipeline.numbers
        self._slots.numbers[slot] = numbers[0]
        self._slots.kalman.belief[slot], self._slots.kalman.variances[slot] = kalman.belief[0], kalman.variances[0]
        self._slots.health_due_ns[slot] = self._scratch[0]["health_due_ns"]
        shared = self._shared.setdefault
        self._slots.rests[slot] = rest._replace(
            units=shared(rest.units, rest.units),
            checks=shared(rest.checks, rest.checks),
            cause=shared(rest.cause, rest.cause),
        )
        return True

    def state_of(self, plant: str) -> bytes:
        """Serialised state of a plant, as its monitor would store it."""
        return seal_state(self._promote(plant, []), self._settings | {"plant": plant})

    def _promote(self, plant: str, waiting: list[Row]) -> MonitorState:
        """State of a monitor of a packed plant, with rows that were aligned and are not processed yet."""
        slots, slot = self._slots, self._slots.of[plant]
        numbers, belief, times_ns = slots.numbers[slot], slots.kalman.belief[slot], [row.time_ns for row in waiting]
        return self._form.promote(
            plant, slots.plants[slot], numbers, belief, slots.rest(slot), slots.newest(slot), times_ns
        )

    def received_count(self, plant: str) -> int:
        """Number of messages of a plant."""
        return int(self._slots.plants["received"][self._slots.of[plant]])

    def count_not_stored(self, plant: str) -> None:
        """Count a failure to store the state of a plant."""
        self._slots.plants["not_stored"][self._slots.of[plant]] += 1

    def give(self, plant: str) -> Monitor:
        """Unpack a plant; returns its monitor."""
        return self._give(plant, [])

    def _give(self, plant: str, waiting: list[Row]) -> Monitor:
        slot = self._slots.of[plant]
        p = self._slots.plants[slot]
        monitor = Monitor(msgspec.structs.replace(self._config, plant=plant), 0, points=False, model=self._model)
        monitor.failures.passes = ()
        try:
            monitor.restore(self._promote(plant, waiting))
        except Exception as error:  # noqa: BLE001 # the plant's border: an error here ends neither node nor fleet
            monitor.failures.add("promotion", error, "the plant is learned again")
        monitor.on_history_end()
        p["health_due_ns"] = self._slots.health_due_ns[slot]
        received_ns, counted_ns = p["receipts"]["received_ns"], p["receipts"]["counted_ns"]
        monitor.stats = _receive_stats(p)
        monitor.silence.of_plant.receipts_ns = int(received_ns), int(counted_ns)
        self._slots.leave(plant)
        return monitor

    # --- samples ---------------------------------------------------------------------------------------------

    def on_messages(
        self, messages: list[Encoded], now_ns: int
    ) -> tuple[list[Publication], list[Encoded], dict[str, Monitor]]:
        """Process samples of packed plants.

        Returns:
            Publications because of them; messages that were not processed, in order: of other plants, or of plants
            that were unpacked; monitors of the latter, which have processed rows up to the first of these messages.
        """
        code_of = self._slots.codes.get
        codes = np.array(
            [code_of(key, -1) if encoding == _SAMPLE else -1 for key, _, encoding, _ in messages], dtype=np.int32
        )
        if codes.max(initial=-1) < 0:
            return [], messages, {}
        samples = parse_samples([payload if len(payload) <= LARGEST_SAMPLE else b"" for _, payload, _, _ in messages])
        received_ns = np.fromiter([came_ns for _, _, _, came_ns in messages], np.int64, len(messages))
        rows, others = self._align(codes, samples, received_ns, now_ns)
        publications: list[Publication] = []
        waiting = self._step_rows(rows, publications)
        given: dict[str, Monitor] = {}
        for code in codes[others].tolist():
            if code >= 0:
                waiting.setdefault(code // len(self._signals), [])
        for slot, left in waiting.items():
            plant = self._slots.names[slot]
            monitor = given[plant] = self._give(plant, left)
            publications += monitor.on_rows(left)
        return publications, [messages[place] for place in others.tolist()], given

    def _align(
        self, codes: NDArray[np.int32], samples: SampleColumns, received_ns: NDArray[np.int64], now_ns: int
    ) -> tuple["_Rows", NDArray[np.int32]]:
        """Align samples; returns complete rows, and the samples that were not processed."""
        most = codes.size // len(self._signals) + min(codes.size, len(self._slots.names))
        rows = _Rows(
            np.empty(most, np.int32),
            np.empty(most, np.int64),
            np.empty((most, len(self._signals))),
        )
        others = np.empty(codes.size, np.int32)
        good = np.isin(samples.quality, list(USABLE))
        count, left_over = take_samples(
            self._slots.plants,
            codes,
            samples.is_canonical & good,
            samples.time_ns,
            samples.sequence,
            samples.value,
            samples.unit,
            received_ns,
            now_ns,
            self._config.silence_periods,
            int(self._form.least_s * 1e9),
            self._form.remembered,
            *rows,
            others,
        )
        return rows.first(count), others[:left_over]

    def _step_rows(self, rows: "_Rows", publications: list[Publication]) -> dict[int, list[Row]]:
        """Take rows through the step; returns, by slot, the first that is an event and all after it."""
        waiting: dict[int, list[Row]] = {}
        found = np.empty(rows.slots.size, np.int32)
        slots, step = self._slots, self._form.step
        step_rows(
            slots.plants,
            words_of(slots.numbers),
            step.frame,
            *slots.kalman,
            step.parameters,
            step.after,
            slots.times,
            slots.ring,
            slots.others,
            rows.slots,
            rows.times_ns,
            rows.values,
            np.array([time_ns / MINUTE_NS for time_ns in rows.times_ns.tolist()]),
            rows.values.view(np.int64),
            found,
        )
        for place in np.flatnonzero(found).tolist():
            slot, time_ns = int(rows.slots[place]), int(rows.times_ns[place])
            if found[place] == NEW_MINUTE:
                publications += self._figures(slot, time_ns)
            else:
                waiting.setdefault(slot, []).append(Row(time_ns, tuple(rows.values[place].tolist()), False))
        return waiting

    def _figures(self, slot: int, time_ns: int) -> list[Publication]:
        """Publish the KPIs of a plant's alarms."""
        rest = self._slots.rest(slot)
        if rest.board is not None:
            publications = rest.board.end_row(time_ns)
        else:
            told = AlarmKpis()
            told.CopyFrom(self._form.figures)
            told.time_ns = time_ns
            publications = [Publication(keys.key(self._slots.names[slot], keys.ALARM_KPIS, NODE), told)]
        self._slots.plants["published"][slot] += len(publications)
        return publications

    # --- the clock -------------------------------------------------------------------------------------------

    def overdue(self, now_ns: int) -> list[str]:
        """Plants whose data timeout has expired."""
        if now_ns < self._overdue_ns and 0 <= now_ns - self._looked_ns < LOOK_AGAIN_NS:
            return []
        due_ns = self._silent_from_ns()
        self._overdue_ns, self._looked_ns = int(due_ns.min(initial=NEVER_NS)), now_ns
        return [self._slots.names[slot] for slot in np.flatnonzero(due_ns <= now_ns).tolist()]

    def healths(self, now_ns: int) -> list[Publication]:
        """Health messages that are due, of at most `MOST_HEALTHS` plants."""
        period_ns = int(self._config.health_period_s * 1e9)
        due = np.flatnonzero(self._slots.health_due_ns <= now_ns)[:MOST_HEALTHS]
        p = self._slots.plants
        p["stalls"][due] += (p["ticked"][due] != 0) & (now_ns - self._slots.health_due_ns[due] > STALL_NS)
        p["ticked"][due] = 1
        self._slots.health_due_ns[due] = now_ns + period_ns
        return [self._health(slot, now_ns, "watching") for slot in due.tolist()]

    def next_due_ns(self) -> int:
        """Earliest deadline of a health message or a data timeout, as far as known."""
        return min(int(self._slots.health_due_ns.min()), self._overdue_ns, self._looked_ns + LOOK_AGAIN_NS)

    def last_healths(self, now_ns: int) -> list[Publication]:
        """Health messages of all plants when the monitor is stopped."""
        return [self._health(slot, now_ns, "stopped") for slot in self._slots.occupied_slots.tolist()]

    def _silent_from_ns(self) -> NDArray[np.int64]:
        """Time by slot at which the data timeout expires; never for a free slot."""
        count = len(self._slots.names)
        plants, numbers = self._slots.plants[:count], self._slots.numbers[:count]
        return find_deadlines(plants, numbers, self._config.silence_periods, int(self._form.least_s * 1e9))

    def _health(self, slot: int, now_ns: int, phase: str) -> Publication:
        p, rest, plant = self._slots.plants[slot], self._slots.rest(slot), self._slots.names[slot]
        health = Health(
            phase=phase,
            received=int(p["received"]),
            published=int(p["published"]),
            failures=rest.failures or {},
            heard_from_ns=dict(zip(self._signals, p["heard_from_ns"].tolist(), strict=True)),
            reference=ProcessReference.kind,
            training=1.0,
        )
        complete_health(health, now_ns, _receive_stats(p), Counts(*p["counts"].tolist()), rest.refused or {})
        p["lag_ns"] = 0
        return Publication(keys.key(plant, keys.HEALTH, NODE), health)


class _Rows(NamedTuple):
    """Rows of several plants.

    Attributes:
        slots: slots of the plants, shape (rows,).
        times_ns: times of the rows, shape (rows,).
        values: values of the rows, the inputs first, shape (rows, signals).
    """

    slots: NDArray[np.int32]
    times_ns: NDArray[np.int64]
    values: NDArray[np.float64]

    def first(self, count: int) -> "_Rows":
        """The first rows."""
        return _Rows(self.slots[:count], self.times_ns[:count], self.values[:count])


def _receive_stats(p: np.void) -> ReceiveStats:
    """Statistics by receive time of a record."""
    return ReceiveStats(*(p[field.name].item() for field in fields(ReceiveStats)))
