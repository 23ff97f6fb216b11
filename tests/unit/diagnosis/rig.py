"""Records of two cascaded tanks, made without a line of the software: the equations by hand, solved by scipy.

The brim is a kink that the solver finds as an event, row by row; nothing about it is smoothed.
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from reactorwatch.arrays import Array
from reactorwatch.records.record import Record

PERIOD_MIN = 1 / 15
BRIM_V = 10.0
NOISE_V = 0.01
LOWER_SPILL_PER_MIN = 30.0


@dataclass(frozen=True)
class Rig:
    """Faults of a rig, from the onset on."""

    overflow_per_min: float = 0.0
    pump: float = 0.0
    leak: float = 0.0
    clogging: float = 0.0
    bias: float = 0.0
    onset_min: float = 0.0
    brim: float = BRIM_V
    caught: float = 0.5
    lower_brim: float = np.inf
    outlet_power: float = 0.5


def record_of(rig: Rig, seed: int, rows: int = 1500) -> Record:
    """The pump changes every 40 seconds, from a rig at rest on; only the lower level is measured."""
    random = np.random.default_rng(seed)
    time_min = PERIOD_MIN * np.arange(rows, dtype=np.float64)
    u = np.repeat(random.uniform(1.0, 4.5, rows // 10 + 1), 10)[:rows]
    u[:10] = 2.0
    levels: Array = np.empty((rows, 2))
    levels[0] = 4.0  # where outflow is inflow: 3 sqrt(4) = 3 * 2
    for row in range(rows - 1):
        levels[row + 1] = _next(rig, time_min[row], levels[row], u[row])
    shown = levels[:, 1] + rig.bias * (time_min >= rig.onset_min) + NOISE_V * random.standard_normal(rows)
    return Record(time_min, {"u": u, "x2": shown}, "tanks")


def _next(rig: Rig, start_min: float, levels: Array, u: float) -> Array:
    on = start_min >= rig.onset_min - 1e-9
    pump, outlet = 3 * u * (1 + on * rig.pump), 3 * (1 - on * rig.clogging)
    leak, spill = on * rig.leak, on * rig.overflow_per_min
    now, end, x, over = start_min, start_min + PERIOD_MIN, levels, bool(levels[0] > rig.brim)
    while now < end:

        def rates(_: float, x: Array, over: bool = over) -> list[float]:
            upper, above = np.sqrt(x[0]), x[0] - rig.brim if over else 0.0
            return [
                pump - (outlet + leak) * upper - spill * above,
                outlet * upper
                - 3 * x[1] ** rig.outlet_power
                + rig.caught * spill * above
                - LOWER_SPILL_PER_MIN * max(x[1] - rig.lower_brim, 0.0),
            ]

        brim = _Brim(-1.0 if over else 1.0, rig.brim)
        found = solve_ivp(rates, (now, end), x, events=brim, rtol=1e-9, atol=1e-11)
        now, x, over = float(found.t[-1]), found.y[:, -1], over != (found.status == 1)
    return x


class _Brim:
    """The upper level comes to the brim, from one side: an event that ends an integration."""

    terminal = True

    def __init__(self, direction: float, brim: float) -> None:
        self.direction, self.brim = direction, brim

    def __call__(self, _: float, x: Array) -> float:
        """Level above the brim."""
        return float(x[0] - self.brim)
