"""Copies of a trained plant, for trials with many plants."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from monitor_node.fleet.monitor import FleetMonitor


def copy_plant(fleet: FleetMonitor, plant: str, name: str) -> None:
    """Adopt a copy of a quiet plant that never had an alarm.

    Args:
        fleet: monitor of a fleet with one kind of plants.
        plant: name of the plant.
        name: name of the copy.
    """
    (packed,) = fleet.watched._quiet_kinds
    slots = packed._slots
    of, slot = slots.of[plant], slots.take(name)
    slots.plants[slot], slots.ring[slot], slots.numbers[slot] = slots.plants[of], slots.ring[of], slots.numbers[of]
    slots.kalman.belief[slot], slots.kalman.variances[slot] = slots.kalman.belief[of], slots.kalman.variances[of]
    slots.health_due_ns[slot] = slots.health_due_ns[of]
    _write_differences(slots.times[slot], slots.times[of])
    _write_differences(slots.others[slot], slots.others[of])
    rest = slots.rest(of)
    slots.rests[slot] = rest._replace(runs=bytes(bytearray(rest.runs)))
    fleet._register.add(name)
    fleet._callbacks.on_ownership(name, True)


def _write_differences(into: NDArray[Any], values: NDArray[Any]) -> None:
    """Write values that differ: pages that were never written take no memory."""
    changed = np.nonzero(into != values)
    into[changed] = values[changed]
